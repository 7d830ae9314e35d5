"""A logger for the terminal: progress, warnings and errors, without Dagster's own events."""

import logging
import os
import re
import shutil
import sys
import time
from typing import TextIO

import dagster as dg

from assets.json_lines import FILE_VARIABLE, TERSE, JsonLines
from nvsf_core.names import printable

TERSE_LOGGING = {"loggers": {TERSE: {"config": {}}}}
"""Run configuration that chooses this logger; without it a job has Dagster's own."""


class _TerseFormatter(logging.Formatter):
    """`HH:MM:SS message`; an unexpected error has its stack trace, an expected `Failure` has not."""

    def format(self, record: logging.LogRecord) -> str:
        clock = time.strftime("%H:%M:%S", time.localtime(record.created))
        meta = getattr(record, "dagster_meta", None) or {}
        lines = [str(meta["orig_message"]) if "orig_message" in meta else record.getMessage()]
        if record.exc_info:
            lines += self.formatException(record.exc_info).split("\n")
        event = meta.get("dagster_event")
        error = getattr(getattr(event, "event_specific_data", None), "error", None)
        if error is not None:
            # RUN_FAILURE repeats the message of STEP_FAILURE.
            told = event.is_run_failure or error.cls_name == "Failure"
            lines += (error.message if told else error.to_string()).split("\n")
        message = "\n".join(map(printable, lines)).rstrip()
        return f"{clock} {message}" if record.levelno < logging.ERROR else f"{clock} ERROR {message}"


def _is_news(record: logging.LogRecord) -> bool:
    """False of Dagster's words for a run that was interrupted: the executor has said it, and how to go on."""
    event = (getattr(record, "dagster_meta", None) or {}).get("dagster_event")
    error = getattr(getattr(event, "event_specific_data", None), "error", None)
    return not (error and event.is_run_failure and error.cls_name == "DagsterExecutionInterruptedError")


_KEPT = re.compile(r"done in|up to date|written|no data|left out|dataset/|FAILED|shows ")
"""Lines that stay: what was finished or decided. Others tell how far a stage is."""
_SHARE = re.compile(r"(\d+)(?:/| of )(\d+)")
_EVERY_S = 15.0
"""Where lines cannot be rewritten, one about progress every so many seconds."""
_BAR = 8
"""Short enough for the time left and the loss to stand within 80 columns."""


class ProgressHandler(logging.Handler):
    """On a terminal one line of progress that rewrites itself; elsewhere few lines, and those that matter."""

    def __init__(self, stream: TextIO) -> None:
        """Write to `stream`."""
        super().__init__()
        self._stream, self._is_terminal = stream, stream.isatty()
        self._is_open, self._said_s = False, -_EVERY_S

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or leave it out; a terminal that is gone does not stop a stage."""
        try:
            self._write(record, self.format(record))
        except Exception:  # as of every handler of `logging`
            self.handleError(record)

    def _write(self, record: logging.LogRecord, line: str) -> None:
        if record.levelno != logging.INFO or _KEPT.search(line):
            self._stream.write(("\r\033[K" if self._is_open else "") + line + "\n")
            self._is_open = False
        elif self._is_terminal:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write("\r\033[K" + with_bar(line)[:width])
            self._is_open = True
        elif time.monotonic() - self._said_s >= _EVERY_S:
            self._stream.write(line + "\n")
            self._said_s = time.monotonic()
        self._stream.flush()


def with_bar(line: str) -> str:
    """A progress line with a bar in front of what it counts, as in `step 100/900` or `3 of 16 frames`."""
    found = _SHARE.search(line)
    if found is None or int(found[2]) == 0:
        return line
    filled = min(_BAR, _BAR * int(found[1]) // int(found[2]))
    return f"{line[: found.start()]}[{'#' * filled}{'.' * (_BAR - filled)}] {line[found.start() :]}"


@dg.logger(
    config_schema={
        "log_level": dg.Field(
            str,
            is_required=False,
            default_value="INFO",
            description="The least level of the messages that are written; DEBUG also writes Dagster's own.",
        )
    },
    description="One short line a message on standard error.",
)
def terse_logger(context: dg.InitLoggerContext) -> logging.Logger:
    """The terminal's logger; with log_level DEBUG it shows Dagster's own events too."""
    level = str(context.logger_config["log_level"]).upper()
    handler = ProgressHandler(sys.stderr) if level == "INFO" else logging.StreamHandler(sys.stderr)
    handler.setFormatter(_TerseFormatter())
    handler.addFilter(_is_news)
    logger = logging.Logger("nvsf", level=level)
    logger.addHandler(handler)
    if os.environ.get(FILE_VARIABLE):
        logger.addHandler(JsonLines(os.environ[FILE_VARIABLE]))
    return logger
