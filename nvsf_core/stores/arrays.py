"""Named arrays in one Zarr group on local disk."""

from collections.abc import Mapping
from pathlib import Path
from types import EllipsisType
from typing import Any

import numpy as np
import zarr

from nvsf_core.errors import StoreError

_CHUNK_BYTES = 4 << 20
"""Target size of a chunk: a frame's worth of returns or one image, so that a reader fetches few files."""


def write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any] | None = None
) -> None:
    """Write arrays (any shape, numeric or bool) and JSON-able attributes as one Zarr group."""
    group = zarr.open_group(str(path), mode="w")
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        stored = group.create_array(name, shape=array.shape, dtype=array.dtype, chunks=_chunks(array))
        if array.size:
            stored[...] = array
    group.attrs.update(dict(attrs or {}))


def read_arrays(path: Path, *names: str) -> dict[str, np.ndarray]:
    """Read the named arrays, or all of them, into memory.

    Raises:
        StoreError: The group or one of the arrays is absent.
    """
    return _read(_open(path), path, names, ...)


def read_part(path: Path, rows: slice, *names: str) -> dict[str, np.ndarray]:
    """Read rows of the named arrays' first axis; little else is fetched.

    Raises:
        StoreError: The group or one of the arrays is absent.
    """
    return _read(_open(path), path, names, rows)


def array_names(path: Path, kind: str) -> list[str]:
    """Names of the arrays of one kind, `f` floating or `i` integer, without reading any."""
    group = _open(path)
    return [name for name, array in sorted(group.arrays()) if array.dtype.kind == kind]


def read_attrs(path: Path) -> dict[str, Any]:
    """Read the group's attributes."""
    return dict(_open(path).attrs)


def _read(
    group: zarr.Group, path: Path, names: tuple[str, ...], rows: slice | EllipsisType
) -> dict[str, np.ndarray]:
    wanted = names or tuple(sorted(group.array_keys()))
    missing = [name for name in wanted if name not in group]
    if missing:
        raise StoreError(
            f"{path}: expected arrays {missing}, found {sorted(group.array_keys())}; make it anew"
        )
    return {name: np.asarray(group[name][rows]) for name in wanted}  # type: ignore[index]


def _open(path: Path) -> zarr.Group:
    if not path.is_dir():
        raise StoreError(f"no Zarr group at {path}; run the stage that makes it")
    return zarr.open_group(str(path), mode="r")


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    """Cut along the first axis only: rows are frames or returns."""
    if array.ndim == 0 or array.size == 0:
        return tuple(max(1, n) for n in array.shape)
    row_bytes = max(1, array.nbytes // array.shape[0])
    return (max(1, min(array.shape[0], _CHUNK_BYTES // row_bytes)), *array.shape[1:])
