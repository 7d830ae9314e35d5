"""Logs as JSON lines beside what the terminal shows: one object a message, for whoever collects logs."""

import contextlib
import json
import logging
import os
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import dagster as dg

from nvsf_core.stages import STAGE_NAMES

FILE_VARIABLE, TERSE = "NVSF_LOG_FILE", "terse"
"""Names the file; the logger that appends to it, where a run's configuration asks for it."""
_SCENE = re.compile(r"\[(?P<scene>[^\]\s]+)\] ")
"""How this project's messages about a scene begin."""
_STAGE = re.compile(rf"(?:FAILED in )?(?P<stage>{'|'.join(STAGE_NAMES)})(?=[:,/])")
"""How they go on where they are about a stage, or what it made."""
_TAKEN = {
    "seconds": re.compile(r"done in ([\d.]+) s"),
    "peak_memory_mb": re.compile(r"([\d.]+) MB of memory"),
    "read_mb": re.compile(r"read ([\d.]+) MB"),
    "written_mb": re.compile(r"wrote ([\d.]+) MB"),
}
"""What a stage took, by the line that says it is done."""


class JsonLines(logging.Handler):
    """Appends each record to a file; several processes may use one, and a full disk stops nothing."""

    def __init__(self, path: str) -> None:
        """Append to the file at `path`, whose folder is made if it is absent."""
        super().__init__()
        self._path = path
        self._is_told = False
        with contextlib.suppress(OSError):  # told with the first record that cannot be written
            Path(path).parent.mkdir(parents=True, exist_ok=True)

    def emit(self, record: logging.LogRecord) -> None:
        """Append one line by one write, so that lines of several processes never mix."""
        try:
            line = json.dumps(facts_of(record)) + "\n"
            handle = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                os.write(handle, line.encode())
            finally:
                os.close(handle)
        except Exception:  # as of every handler of `logging`, but told once and not with every record
            if not self._is_told:
                self._is_told = True
                self.handleError(record)


def log_as_json(context: dg.AssetExecutionContext) -> None:
    """Let this step append its messages to the file of NVSF_LOG_FILE, if no logger of its run does.

    The runs of `scenes_follow`, of the schedule and of the UI's button are configured without one.
    """
    path = os.environ.get(FILE_VARIABLE)
    if path and TERSE not in context.run.run_config.get("loggers", {}):
        handler = JsonLines(path)
        handler.setLevel(logging.INFO)  # Dagster's own bookkeeping is DEBUG
        context.log.addHandler(handler)


def facts_of(record: logging.LogRecord) -> dict[str, Any]:
    """What a record says: `time`, `level`, `message`; the run, job and step; scene, stage and what it took.

    The partition of a scene's stage is the scene.
    """
    meta = getattr(record, "dagster_meta", None) or {}
    message = str(meta.get("orig_message") or record.getMessage())
    found: dict[str, Any] = {
        "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
        "level": record.levelname.lower(),
        "message": message,
        "process": record.process,
    }
    found |= {
        name: meta[key]
        for name, key in (("run_id", "run_id"), ("job", "job_name"), ("step", "step_key"))
        if meta.get(key)
    }
    if (subject := _SCENE.match(message)) is not None:
        found["scene"] = subject["scene"]
        if (stage := _STAGE.match(message, subject.end())) is not None:
            found |= {
                "stage": stage["stage"],
                "partition": subject["scene"],
                **_taken(message[stage.end() :]),
            }
    if record.exc_info:
        found["error"] = logging.Formatter().formatException(record.exc_info)
    return found


def _taken(words: str) -> dict[str, float]:
    matches = {name: pattern.search(words) for name, pattern in _TAKEN.items()}
    if matches["seconds"] is None:
        return {}
    return {name: float(match[1]) for name, match in matches.items() if match is not None}
