"""For a document of measurements: where it lies, tables, its generated part, the commit that was measured."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from nvsf_core.stages.runner.host import code_commit

ROOT = Path(__file__).resolve().parents[2]
"""Of the checkout."""
RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"


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
