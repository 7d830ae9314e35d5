"""Sizes and checksums of an output's files, to detect missing or changed ones."""

import hashlib
import json
import zlib
from collections.abc import Mapping
from pathlib import Path

__all__ = ["checksum_of", "damaged_file", "file_checksums", "json_digest"]

_BLOCK_BYTES = 4 << 20


def file_checksums(folder: Path, leave_out: frozenset[str] = frozenset()) -> dict[str, str]:
    """Path of every file below `folder`, except those in `leave_out`, to `<bytes>-<crc32 in hex>`."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    named = ((path.relative_to(folder).as_posix(), path) for path in files)
    return {name: checksum_of(path) for name, path in named if name not in leave_out}


def damaged_file(folder: Path, listed: Mapping[str, str]) -> str | None:
    """The first listed file that is absent or changed; None if none is. Files not listed are ignored."""
    for name, checksum in listed.items():
        path = folder / name
        # The size first: it is cheap, and finds truncated and enlarged files.
        try:
            if not path.is_file() or path.stat().st_size != int(checksum.split("-")[0]):
                return name
            if checksum_of(path) != checksum:
                return name
        except (OSError, ValueError):
            return name
    return None


def json_digest(value: object) -> str:
    """SHA-256 of a value as JSON, its keys sorted."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def checksum_of(path: Path) -> str:
    """A file's size and checksum: `<bytes>-<crc32 in hex>`."""
    crc = size = 0
    with path.open("rb") as handle:
        while block := handle.read(_BLOCK_BYTES):
            crc, size = zlib.crc32(block, crc), size + len(block)
    return f"{size}-{crc:08x}"
