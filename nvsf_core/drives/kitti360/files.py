"""Files of a drive as bytes: regular ones, no larger than they can be, the same as when validated."""

import hashlib
from pathlib import Path

from nvsf_core.drives.kitti360.text import is_there
from nvsf_core.errors import DataError


def read_bytes(path: Path, most_bytes: int, what: str) -> bytes:
    """The content of a regular file of at most so many bytes; its size is asked before it is read.

    Args:
        path: Of the file.
        most_bytes: Largest size that such a file can have.
        what: `scan` or `image`, for the message.

    Raises:
        DataError: It is absent, a folder, a pipe or a device, or too large.
    """
    try:
        if is_there(path) and not path.is_file():
            raise DataError(
                f"{path}: expected a {what}, found a folder, a pipe or a device, or a link to nowhere; "
                "copy it again"
            )
        size = path.stat().st_size
        if size > most_bytes:
            raise DataError(
                f"{path}: expected a {what} of at most {most_bytes:,} bytes, found {size:,}; copy it again"
            )
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"no {what} file {path} ({error.strerror}); unpack the drive's {what}s") from error


def checksum_of(data: bytes) -> str:
    """First 16 hex digits of the SHA-256 of a file's content."""
    return hashlib.sha256(data).hexdigest()[:16]


def require_unchanged(path: Path, data: bytes, validated: str) -> None:
    """Refuse a file that is not the one that was validated.

    Args:
        path: Where it is from, for the message.
        data: Its content.
        validated: Its checksum then; empty = none is known.

    Raises:
        DataError: The checksums differ.
    """
    if validated and checksum_of(data) != validated:
        raise DataError(
            f"{path}: changed since the stage `frames` validated it (expected SHA-256 {validated}..., found "
            f"{checksum_of(data)}...); run again, and where that does not help delete the scene's output "
            "`frames` first"
        )
