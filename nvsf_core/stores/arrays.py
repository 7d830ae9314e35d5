"""Named arrays in one Zarr group on local disk, each chunk with a checksum (crc32c).

Reading gives what was written, or a StoreError. Zarr alone would read missing chunks as zeros.
"""

import contextlib
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import EllipsisType
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import ByteRequest
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore

from nvsf_core.errors import StoreError
from nvsf_core.stores.documents import Contents, foreign, unreadable
from nvsf_core.stores.schemas import field_faults, spec_at, violations

_METADATA = "zarr.json"
_MOST_CHUNKS = 1_000_000
_MOST_CHUNK_BYTES = 4 << 30
_HEADROOM_BYTES = 4 << 20
_CHUNK_BYTES = 4 << 20
"""Target size of a chunk: a frame's worth of returns or one image, so that a reader fetches few files."""

_SMALL_BYTES = 64 << 10
"""To hand a file to another thread and wait for it takes about as long as to read so much."""


class LocalFiles(LocalStore):
    """As zarr's own, which hands each file to another thread: most files here are small, a group has dozens.

    Large chunks still go to other threads, several at once.
    """

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Bytes of a file, or of a part of it; None if there is none."""
        if _is_large(self.root / key):
            return await super().get(key, prototype, byte_range)
        return self.get_sync(key, prototype=prototype, byte_range=byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file whole."""
        if len(value) > _SMALL_BYTES:
            await super().set(key, value)
        else:
            self.set_sync(key, value)


def _is_large(path: Path) -> bool:
    try:
        return path.stat().st_size > _SMALL_BYTES
    except OSError:
        return False


def write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any] | None = None
) -> None:
    """Write arrays (any shape, numeric or bool) and JSON-able attributes as one Zarr group."""
    group = zarr.open_group(LocalFiles(path), mode="w")
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        stored = group.create_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunks=_chunks(array),
            compressors=[ZstdCodec(level=0), Crc32cCodec()],
            # Else chunks of zeros are not written, and a lost chunk looks like one of them.
            config={"write_empty_chunks": True},
        )
        if array.size:
            stored[...] = array
    group.attrs.update(dict(attrs or {}))


def read_arrays(path: Path, *names: str) -> dict[str, np.ndarray]:
    """Read the named arrays, or all of them, into memory.

    Raises:
        StoreError: The group or an array is absent, damaged, or breaks the data contract.
    """
    with _reading(path):
        group = _open(path)
        arrays = _read(group, path, names, ...)
    spec = spec_at(path)
    faults = [] if spec is None else violations(spec, arrays, whole=False)
    if faults:
        raise foreign(path, "; ".join(faults[:3]))
    return arrays


def read_part(path: Path, rows: slice, *names: str) -> dict[str, np.ndarray]:
    """Read some rows of the named arrays; only their chunks are fetched.

    Raises:
        StoreError: The group or an array is absent, damaged, or breaks the data contract.
    """
    with _reading(path):
        return _read(_open(path), path, names, rows)


def array_layouts(path: Path) -> dict[str, np.ndarray]:
    """Name to a dummy array of the stored type and shape, without memory of its own; no chunk is read.

    Raises:
        StoreError: The group is absent or damaged.
    """
    with _reading(path):
        stored = dict(_open(path).arrays())
    return {name: np.broadcast_to(np.empty((), one.dtype), one.shape) for name, one in stored.items()}


def holds_array(path: Path, name: str) -> bool:
    """Whether a group has an array of that name; nothing is read.

    Raises:
        StoreError: The group is absent.
    """
    if not path.is_dir():
        raise _absent(path)
    return (path / name / _METADATA).is_file()


def array_names(path: Path, kind: str) -> list[str]:
    """Names of the arrays of one kind: `f` (floating) or `i` (integer); none is read.

    Raises:
        StoreError: The group is absent or damaged.
    """
    with _reading(path):
        return [name for name, array in sorted(_open(path).arrays()) if array.dtype.kind == kind]


def read_attrs(path: Path) -> dict[str, Any]:
    """Read the group's attributes.

    Raises:
        StoreError: The group is absent or damaged.
    """
    with _reading(path):
        return Contents(path, dict(_open(path).attrs))


def _read(
    group: zarr.Group, path: Path, names: tuple[str, ...], rows: slice | EllipsisType
) -> Contents[np.ndarray]:
    # Only those that are wanted are opened: a group has dozens.
    present = sorted(entry.name for entry in path.iterdir() if (entry / _METADATA).is_file())
    wanted = names or tuple(present)
    missing = [name for name in wanted if name not in present]
    if missing:
        raise foreign(path, f"expected arrays {missing}, found {present}")
    members: dict[str, Any] = {name: group[name] for name in wanted}
    spec = spec_at(path)
    found: Contents[np.ndarray] = Contents(path)
    for name, stored in members.items():
        # Checked before reading: a manipulated shape may need more memory than there is.
        faults = () if spec is None else field_faults(spec, name, stored.dtype, stored.shape)
        for fault in faults:
            raise foreign(path, fault)
        _require_chunks(path, name, stored)
        found[name] = np.asarray(stored[rows])
    return found


def _require_chunks(path: Path, name: str, stored: Any) -> None:
    """Check number and size of an array's chunk files; Zarr's own list of a huge shape would take all memory.

    Raises:
        StoreError: Chunks are missing or too large.
    """
    chunk_bytes = math.prod(stored.chunks) * stored.dtype.itemsize
    expected = math.prod(-(-n // chunk) for n, chunk in zip(stored.shape, stored.chunks, strict=True))
    sizes = [file.stat().st_size for file in _files(path / name) if file.name != _METADATA]
    if len(sizes) != expected or expected > _MOST_CHUNKS:
        raise foreign(path, f"{name}: expected {expected} chunks, found {len(sizes)}")
    if max(sizes, default=0) > 2 * chunk_bytes + _HEADROOM_BYTES or chunk_bytes > _MOST_CHUNK_BYTES:
        raise foreign(
            path, f"{name}: expected chunks of {chunk_bytes:,} bytes, found one of {max(sizes, default=0):,}"
        )


def _absent(path: Path) -> StoreError:
    return StoreError(f"no Zarr group at {path}; run the stage that makes it")


def _open(path: Path) -> zarr.Group:
    if not path.is_dir():
        raise _absent(path)
    for file in _files(path):
        # Opening a pipe would block for ever.
        if not file.is_file(follow_symlinks=False):
            raise foreign(path, f"expected regular files, found something else at {file.path}")
        if file.name == _METADATA and file.stat().st_size > _HEADROOM_BYTES:
            raise foreign(path, f"{file.path}: expected metadata, found {file.stat().st_size:,} bytes")
    return zarr.open_group(LocalFiles(path, read_only=True), mode="r")


def _files(folder: str | Path) -> Iterator[os.DirEntry[str]]:
    """All that is in a folder and those in it, but folders and links to some; unlike paths, cheap to ask."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.is_dir():
                yield entry
            elif not entry.is_symlink():
                yield from _files(entry.path)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn the many kinds of errors that Zarr, its codecs and JSON raise on damaged data into one.

    Raises:
        StoreError: Anything failed inside.
    """
    try:
        yield
    except StoreError:
        raise
    except Exception as error:
        words = f"expected what this project wrote, found it damaged ({error!r:.300})"
        raise unreadable(path, error, words) from error


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    """Chunk shape: cut along the first axis only, whose rows are frames or returns."""
    if array.ndim == 0 or array.size == 0:
        return tuple(max(1, n) for n in array.shape)
    row_bytes = max(1, array.nbytes // array.shape[0])
    return (max(1, min(array.shape[0], _CHUNK_BYTES // row_bytes)), *array.shape[1:])
