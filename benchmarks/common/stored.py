"""Results as JSON, replaced as a whole: a killed run leaves the old file."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.common.documents import commit
from nvsf_core.stages.runner.host import machine

Row = dict[str, Any]


def write_json(path: Path, value: object) -> None:
    """Write anything, indented."""
    write_whole(path, json.dumps(value, indent=1) + "\n")


def write_measured(path: Path, facts: Mapping[str, Any]) -> None:
    """Write facts with the machine and the commit that they were measured on."""
    write_json(path, {"machine": machine(), "commit": commit(), **facts})


def read_rows(path: Path) -> list[Row]:
    """The rows of a file that is a list of them; none where there is no file."""
    return json.loads(path.read_text()) if path.is_file() else []


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows, one a line."""
    write_whole(path, "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


def write_whole(path: Path, text: str) -> None:
    """Write a text so that nobody sees a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_text(text)
    partial.replace(path)
