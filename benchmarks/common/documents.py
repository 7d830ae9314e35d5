"""For measurements: documents with tables and generated parts, results as JSON, the commit and machine."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nvsf_core.stages.runner.host import code_commit, machine

ROOT = Path(__file__).resolve().parents[2]
"""Of the checkout."""
RESULTS_DIR = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"
Row = dict[str, Any]


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]], rule: str = "") -> str:
    """A table, each row on a line that ends; `rule` is the line below the head, where it aligns columns."""
    lines = [_line(head), rule or _line(["---"] * len(head)), *map(_line, rows)]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def write_between(document: Path, name: str, text: str) -> None:
    """Replace what stands between ``<!-- name -->`` and ``<!-- end of name -->``, each on a line of its own.

    Raises:
        ValueError: The document does not have both, once.
    """
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    parts = document.read_text().split(begin)
    if len(parts) != 2 or parts[1].count(end) != 1:
        raise ValueError(f"{document}: expected {begin.strip()} and {end.strip()} once each; put them back")
    document.write_text(parts[0] + begin + text + end + parts[1].split(end)[1])


def commit() -> str:
    """Short commit of this checkout; `unknown` outside one."""
    return code_commit()[:7]


def measured_on() -> str:
    """The paragraph above a table: machine and commit."""
    return f"{machine()}; commit {commit()}.\n\n"


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
