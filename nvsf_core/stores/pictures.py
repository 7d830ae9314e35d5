"""Pictures that an output was published with, for pages that show them."""

from pathlib import Path

MOST_BYTES = 8 << 20
"""The largest preview has 1 MB."""
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_picture(path: Path) -> bytes | None:
    """The content of a PNG file; None where there is none: a link could lead to anything."""
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_BYTES:
            return None
        content = path.read_bytes()
    except OSError:
        return None
    return content if content.startswith(_PNG_SIGNATURE) else None
