"""Replaces the generated part of a document, which lies between two marker comments."""

from pathlib import Path


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
