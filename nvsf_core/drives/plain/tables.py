"""Reading of a plain drive's tables: CSV files with a header row, of finite numbers."""

import csv
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.text import FARTHEST_M, MIB, require_regular, rigid
from nvsf_core.drives.posed import PosePath, require_ascending
from nvsf_core.errors import DataError

_MOST_BYTES = 256 * MIB
_LONGEST_LINE, _MOST_CELLS = 65_536, 50_000_000
"""Characters of a line, and numbers of a table: 400 MB. Poses of 1 kHz for an hour are 47 million."""
_LONGEST_STEP_S, _LATEST_S = 30.0, 1e11
"""Median step, and time, beyond which times are of another unit: 30 Hz in milliseconds, the year 5138."""
_OTHER_SEPARATOR = re.compile(r"[;\t|]|\S\s+\S")
_PLACE = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))


def read_rows(path: Path) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Names of a CSV file's first row, and line number and cells of each other row.

    Empty lines and those that begin with # are left out. A row is read when it is asked for.

    Raises:
        DataError: It cannot be read, is too large, or its first row has no names or one twice.
    """
    rows = _lines(path)
    _, cells = next(rows, (0, []))
    names = [name.strip() for name in cells]
    if len(names) == 1 and _OTHER_SEPARATOR.search(names[0]):
        raise DataError(f"{path}: expected names and numbers apart by commas, found {names[0]!r:.80}")
    if not names or len(set(names)) != len(names):
        raise DataError(
            f"{path}: expected a row of different column names and then rows of numbers, found "
            f"{f'first {names}' if names else '0 rows'!s:.100}"
        )
    return names, rows


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of a CSV file's lines; what is in memory is one of them."""
    try:
        require_regular(path, _MOST_BYTES)
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), start=1):
                if len(line) == _LONGEST_LINE:
                    raise ValueError(f"line {number}: expected at most {_LONGEST_LINE:,} characters")
                if line.strip() and not line.lstrip().startswith("#"):
                    yield number, next(csv.reader([line], strict=True))
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"cannot read {path} ({error}); docs/drives.md says what it holds") from error


def read_columns(path: Path, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Columns (n,) float64 of a CSV file by the name in its first row; others may hold anything.

    Raises:
        DataError: It cannot be read, a needed column is absent, it has no rows or too many, or a cell is not
            a finite number; the message names the line and column.
    """
    names, rows = read_rows(path)
    absent = [name for name in needed if name not in names]
    if absent:
        raise DataError(
            f"{path}: expected the columns {', '.join(needed)}, found {', '.join(names)!s:.200}; add "
            f"{', '.join(absent)}"
        )
    used = [k for k, name in enumerate(names) if name in (*needed, *optional)]
    # One number takes 8 bytes; as Python's own, or as text, several times that.
    columns = {names[k]: array("d") for k in used}
    for number, cells in rows:
        if len(cells) != len(names):
            raise DataError(f"{path}, line {number}: expected {len(names)} cells, found {len(cells)}")
        if len(used) * len(columns[names[used[0]]]) >= _MOST_CELLS:
            raise DataError(f"{path}: expected at most {_MOST_CELLS:,} numbers, found more; cut the drive")
        for k in used:
            try:
                columns[names[k]].append(finite_number(cells[k]))
            except ValueError as error:
                raise DataError(f"{path}, line {number}, {names[k]}: {error}; correct it") from error
    if not columns[names[used[0]]]:
        raise DataError(f"{path}: expected rows of numbers below the names, found none")
    return {name: np.frombuffer(column) for name, column in columns.items()}


def _line(path: Path, row: int) -> int:
    """Number of the line that a row of numbers, counted from 0, stands in."""
    return next(islice(read_rows(path)[1], row, None))[0]


def finite_number(cell: str) -> float:
    """The number of a cell.

    Raises:
        ValueError: It is none, or not finite.
    """
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number, found {cell!r:.40}")
    return value


def frame_numbers(columns: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    """(n,) int64 of the column `frame`, each once.

    Raises:
        DataError: One is no frame number, or stands twice.
    """
    frames = columns["frame"]
    bad = np.flatnonzero((frames < 0) | (frames != np.floor(frames)) | (frames >= 1e10))
    if len(bad):
        raise DataError(
            f"{path}, line {_line(path, int(bad[0]))}: expected a frame number, found {frames[bad[0]]:g}"
        )
    whole = frames.astype(np.int64)
    names, count = np.unique(whole, return_counts=True)
    if (count > 1).any():
        raise DataError(f"{path}: expected each frame once, found {names[count > 1][0]} again")
    return whole


def _require_seconds(time_s: np.ndarray, path: Path) -> None:
    """Refuse times (n,) that only another unit explains.

    Raises:
        DataError: They are later than any date, or farther apart than any drive's.
    """
    step_s = float(np.median(np.abs(np.diff(time_s)))) if len(time_s) > 1 else 0.0
    if step_s > _LONGEST_STEP_S or np.abs(time_s).max() > _LATEST_S:
        raise DataError(
            f"{path}: time_s: expected seconds, found {time_s[0]:.17g}, and rows {step_s:g} apart in the "
            "median; divide milliseconds by 1e3, microseconds by 1e6, nanoseconds by 1e9"
        )


def read_times(path: Path) -> dict[int, float]:
    """Frame to seconds, of a table with the columns `frame` and `time_s`.

    Raises:
        DataError: See `read_columns`; or frames or times do not ascend.
    """
    columns = read_columns(path, ("frame", "time_s"))
    frames = frame_numbers(columns, path)
    _require_seconds(columns["time_s"], path)
    require_ascending(columns["time_s"], str(path), partial(_line, path))
    require_ascending(frames.astype(np.float64), f"{path}, column frame", partial(_line, path))
    return dict(zip(frames.tolist(), columns["time_s"].tolist(), strict=True))


def read_pose_table(path: Path) -> tuple[PosePath, np.ndarray | None]:
    """The poses of `poses.csv`, and the frame (n,) of each, or None without that column.

    A row is `time_s` and either `x, y, z, qx, qy, qz, qw` or the upper three rows `m00` to `m23` of a matrix.

    Raises:
        DataError: See `read_columns`; or a pose is no rotation with a place on Earth.
    """
    is_matrix = "m00" in read_rows(path)[0]
    parts = _MATRIX if is_matrix else (*_PLACE, *_QUATERNION)
    columns = read_columns(path, ("time_s", *parts), ("frame",))
    if is_matrix:
        values = np.stack([columns[name] for name in _MATRIX], axis=1)
    else:
        values = _matrices(columns, path)
    _require_seconds(columns["time_s"], path)
    require_ascending(columns["time_s"], str(path), partial(_line, path))
    poses = []
    for number, row in enumerate(values):
        try:
            poses.append(rigid(row, FARTHEST_M))
        except ValueError as error:
            line = _line(path, number)
            raise DataError(f"{path}, line {line}: {error}; correct it, or delete the row") from error
    frames = frame_numbers(columns, path) if "frame" in columns else None
    return PosePath(columns["time_s"], np.stack(poses), path), frames


def _matrices(columns: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    """(n, 12) upper rows of poses of a place and a quaternion."""
    quaternion = np.stack([columns[name] for name in _QUATERNION], axis=1)
    short = np.flatnonzero(np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 0.01)
    if len(short):
        raise DataError(
            f"{path}, line {_line(path, int(short[0]))}: expected a quaternion of length 1, found "
            f"{quaternion[short[0]].tolist()}; their order is qx, qy, qz, qw"
        )
    rotation = Rotation.from_quat(quaternion).as_matrix()
    place = np.stack([columns[name] for name in _PLACE], axis=1)
    return np.concatenate([rotation, place[:, :, None]], axis=2).reshape(-1, 12)
