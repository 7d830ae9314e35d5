"""Markdown tables for the documents."""

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]], rule: str = "") -> str:
    """A table, each row on a line that ends.

    Args:
        head: Titles of the columns.
        rows: Cells as they are shown.
        rule: The line below the head, where it aligns columns; default `| --- |` for each.
    """
    lines = [_line(head), rule or _line(["---"] * len(head)), *map(_line, rows)]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"
