"""Hashes of files by content, remembered so that unchanged files are not read again.

A hash is believed while the file's size, modification time, change time and inode are those that it was read
with. A file that was changed shortly before it was read is read again: within one tick of the disk's clock a
second change would leave no trace in its times.
"""

import contextlib
import fcntl
import hashlib
import os
import stat
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from nvsf_core.errors import StoreError
from nvsf_core.stores.documents import read_document, write_document

TICK_NS = 2_000_000_000
"""Longest tick of a disk's clock: two seconds, of FAT; others count nanoseconds or a few milliseconds."""
_BLOCK_BYTES = 4 << 20
_LARGEST_BYTES = 1 << 30
"""Larger files, as long bags, count by size and time of their last change: to read them takes long."""
_ENTRY_LENGTH = 6


class TimeIsUpError(StoreError):
    """The hashes were asked for within a given time, which has passed; what was read is remembered."""


@dataclass(slots=True)
class FileHashes:
    """Hashes of files, remembered in a JSON document that several processes may use at once.

    A damaged or foreign document counts as empty and is written anew.
    """

    document: Path
    """The document; its folder is made when something is to be remembered."""
    read_anew: bool = False
    """Read every file, whatever is remembered of it."""
    until_s: float = float("inf")
    """`time.monotonic()` after which no further file is read."""
    bytes_read: int = 0
    """Bytes of the files that were read."""
    _known: dict[str, list[int | str]] = field(default_factory=dict)
    _new: dict[str, list[int | str]] = field(default_factory=dict)

    def __enter__(self) -> Self:
        """Load what is remembered."""
        self._known = _load(self.document)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remember what was read, also after an error; a disk that refuses is no failure."""
        if self._new:
            with contextlib.suppress(OSError):
                self._remember()

    def hash_of(self, path: Path) -> str:
        """SHA-256 of a file's bytes; of no regular file its kind and size, of a large one its size and time.

        Raises:
            OSError: It is absent or cannot be read.
            TimeIsUpError: It would have to be read, and the time is up.
        """
        before = path.stat()
        if not stat.S_ISREG(before.st_mode):
            return f"kind {stat.S_IFMT(before.st_mode):o}, {before.st_size} bytes"
        if before.st_size > _LARGEST_BYTES:
            return f"{before.st_size} bytes, changed at {before.st_mtime_ns} ns"
        name = str(path.absolute())
        known = self._new.get(name) or (None if self.read_anew else self._known.get(name))
        if known is not None and _is_believed(known, before):
            return str(known[-1])
        if time.monotonic() > self.until_s:
            raise TimeIsUpError(f"{path} was not read yet")
        moment_ns = time.time_ns()
        digest = _sha256(path)
        self.bytes_read += before.st_size
        # Remembered with the times from before: if it was changed meanwhile, they do not fit any more.
        self._new[name] = [*_times(before), moment_ns, digest]
        return digest

    def _remember(self) -> None:
        self.document.parent.mkdir(parents=True, exist_ok=True)
        with _locked(self.document.with_name(f".{self.document.name}.lock")):
            # Read again: another process may have written since.
            merged = _load(self.document) | self._new
            write_document(self.document, {"files": merged})


def _is_believed(entry: list[int | str], found: os.stat_result) -> bool:
    *times, moment_ns, _ = entry
    changed_ns = max(found.st_mtime_ns, found.st_ctime_ns)
    return times == _times(found) and int(moment_ns) - changed_ns >= TICK_NS


def _times(found: os.stat_result) -> list[int]:
    return [found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino]


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as handle:
        while block := handle.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def _load(document: Path) -> dict[str, list[int | str]]:
    """What a document remembers; nothing if it is absent, damaged or foreign."""
    try:
        files = read_document(document).get("files")
    except StoreError:
        return {}
    if not isinstance(files, dict):
        return {}
    return {name: entry for name, entry in files.items() if _is_entry(entry)}


def _is_entry(entry: object) -> bool:
    if not isinstance(entry, list) or len(entry) != _ENTRY_LENGTH:
        return False
    *numbers, digest = entry
    return isinstance(digest, str) and all(type(number) is int for number in numbers)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock of the operating system, which is free again as soon as its holder dies."""
    with path.open("a") as handle:
        fcntl.flock(handle.fileno(), fcntl.LOCK_EX)
        yield
