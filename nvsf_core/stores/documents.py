"""JSON documents and PNG pictures on disk; documents are replaced atomically."""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from nvsf_core.errors import StoreError
from nvsf_core.stores.writers import leftovers, temporary_of

MOST_BYTES = 64 << 20
"""Largest document that is read; stages write smaller ones."""


def read_document(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        StoreError: The file is absent, not a regular file, too large, or not a JSON object.
    """
    if not path.is_file():
        raise StoreError(f"no document at {path}; run the stage that makes it")
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(f"{size:,} bytes")
        found = json.loads(path.read_text(encoding="utf-8"))
    # Thousands of nested brackets raise a RecursionError.
    except (OSError, ValueError, RecursionError) as error:
        raise unreadable(
            path, error, f"expected a JSON object of at most {MOST_BYTES >> 20} MiB, found {error!s:.200}"
        ) from error
    if not isinstance(found, dict):
        raise foreign(path, f"expected a JSON object, found a {type(found).__name__}")
    return Contents(path, found)


def write_document(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON object atomically: a reader sees the old file or the new one, also after a power cut.

    What killed writers left of documents in this folder is removed.
    """
    remove_left_documents(path.parent)
    temporary = temporary_of(path)
    try:
        with temporary.open("w") as handle:
            handle.write(json.dumps(dict(values), indent=1))
            handle.flush()
            os.fsync(handle.fileno())
        temporary.replace(path)
    except OSError:  # a full disk
        temporary.unlink(missing_ok=True)
        raise


def remove_left_documents(folder: Path) -> None:
    """Remove what killed writers left of single files in a folder; a disk that refuses keeps it."""
    for left in leftovers(folder):
        with contextlib.suppress(OSError):
            left.unlink()


_Value = TypeVar("_Value")


class Contents(dict[str, _Value]):
    """A dict read from a file, whose `[name]` raises a StoreError with the file for an absent name."""

    __slots__ = ("path",)

    def __init__(self, path: Path, *named: Any) -> None:
        """Take the file and the arguments of `dict`."""
        super().__init__(*named)
        self.path = path

    def __missing__(self, name: str) -> NoReturn:
        """Raise the error of an absent name.

        Raises:
            StoreError: Always; names the file, its content, and what to delete.
        """
        raise foreign(self.path, f"expected {name!r}, found {', '.join(sorted(self)[:40]) or 'nothing'}")


def foreign(path: Path, found: str) -> StoreError:
    """The error for a stored file that is damaged or not this project's; its folder is to be made again.

    `found` says what was expected and what was found.
    """
    return StoreError(f"{path}: {found}; delete {path.parent} and run again: it is then made anew")


def unreadable(path: Path, error: Exception, damaged: str) -> StoreError:
    """The error for a stored file that cannot be read: it may be whole, and this user may not read it.

    `damaged` says what was expected and found where it is not a matter of permissions.
    """
    if isinstance(error, PermissionError):
        return StoreError(
            f"{path}: permission denied; it may well be whole: correct its owner or permissions"
        )
    return foreign(path, damaged)


MOST_PICTURE_BYTES = 8 << 20
"""Largest picture that is read; previews have 1 MB at most."""
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_picture(path: Path) -> bytes | None:
    """The content of a PNG file; None if it is absent, a link, too large, or no PNG."""
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_PICTURE_BYTES:
            return None
        content = path.read_bytes()
    except OSError:
        return None
    return content if content.startswith(_PNG_SIGNATURE) else None
