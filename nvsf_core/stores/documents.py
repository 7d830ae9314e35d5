"""JSON documents and PNG pictures on disk: read whole or refused; documents are replaced whole."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from nvsf_core.errors import StoreError

MOST_BYTES = 64 << 20
"""Larger than any document that a stage writes; what is larger is no document."""


def read_document(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        StoreError: The file is absent, no regular file, too large, or holds no JSON object.
    """
    if not path.is_file():
        raise StoreError(f"no document at {path}; run the stage that makes it")
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(f"{size:,} bytes")
        found = json.loads(path.read_text(encoding="utf-8"))
    # Text that nests some thousand brackets deep ends in a RecursionError.
    except (OSError, ValueError, RecursionError) as error:
        raise foreign(
            path, f"expected a JSON object of at most {MOST_BYTES >> 20} MiB, found {error!s:.200}"
        ) from error
    if not isinstance(found, dict):
        raise foreign(path, f"expected a JSON object, found a {type(found).__name__}")
    return Contents(path, found)


def write_document(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON object; the file at `path` is the old one or the new one."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(dict(values), indent=1))
    temporary.replace(path)


_Value = TypeVar("_Value")


class Contents(dict[str, _Value]):
    """A dict whose `[name]` raises a StoreError for an absent name; a KeyError would name no file."""

    __slots__ = ("path",)

    def __init__(self, path: Path, *named: Any) -> None:
        """Hold what `dict` takes, read from `path`."""
        super().__init__(*named)
        self.path = path

    def __missing__(self, name: str) -> NoReturn:
        """Refuse.

        Raises:
            StoreError: Names the file, what it has, and what to delete.
        """
        raise foreign(self.path, f"expected {name!r}, found {', '.join(sorted(self)[:40]) or 'nothing'}")


def foreign(path: Path, found: str) -> StoreError:
    """The error of a stored file that is damaged, or not what this project writes.

    Args:
        path: The file or group; its folder is the output that is to be made anew.
        found: What was expected of it and what was found.
    """
    return StoreError(f"{path}: {found}; delete {path.parent} and run again: it is then made anew")


MOST_PICTURE_BYTES = 8 << 20
"""The largest preview has 1 MB."""
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_picture(path: Path) -> bytes | None:
    """The content of a PNG file; None where there is none: a link could lead to anything."""
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_PICTURE_BYTES:
            return None
        content = path.read_bytes()
    except OSError:
        return None
    return content if content.startswith(_PNG_SIGNATURE) else None
