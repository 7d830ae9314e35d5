"""Reading of a plain drive's tables: CSV files with a header row, of finite numbers."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.boxes import STATIC_FRAME, Box
from nvsf_core.drives.kitti360.text import FARTHEST_M, MIB, read_text, rigid
from nvsf_core.drives.posed import PosePath, require_ascending
from nvsf_core.errors import DataError

_MOST_BYTES, _MOST_ID = 256 * MIB, 2**31 - 1
_PLACE = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))
_SIZE = ("length", "width", "height")


def read_columns(path: Path, text_columns: Sequence[str] = (), fewest_rows: int = 1) -> dict[str, np.ndarray]:
    """Columns of a CSV file by the name in its first row: float64, or text for those named.

    Raises:
        DataError: It cannot be read, has fewer rows than `fewest_rows`, or a cell is not a finite number; the
            message names the row and column.
    """
    try:
        text = read_text(path, _MOST_BYTES)
        rows = list(csv.reader(io.StringIO(text)))
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"cannot read {path} ({error}); docs/drives.md says what it holds") from error
    rows = [row for row in rows if row and not row[0].lstrip().startswith("#")]
    names = [name.strip() for name in rows[0]] if rows else []
    if len(rows) <= fewest_rows or not names or len(set(names)) != len(names):
        raise DataError(f"{path}: expected a row of different column names and then rows of numbers, found "
                        f"{len(rows)} rows, first {names!s:.100}")  # fmt: skip
    columns: dict[str, list[float | str]] = {name: [] for name in names}
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(names):
            raise DataError(f"{path}, row {number}: expected {len(names)} cells, found {len(row)}")
        for name, cell in zip(names, row, strict=True):
            columns[name].append(
                cell.strip() if name in text_columns else _number(cell, f"{path}, row {number}, {name}")
            )
    return {name: np.array(values) for name, values in columns.items()}


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise DataError(f"{where}: expected a finite number, found {cell!r:.40}")
    return value


def require_columns(columns: Mapping[str, np.ndarray], names: Sequence[str], path: Path) -> None:
    """Refuse a table without these columns.

    Raises:
        DataError: One is absent.
    """
    absent = [name for name in names if name not in columns]
    if absent:
        raise DataError(
            f"{path}: expected the columns {', '.join(names)}, found {', '.join(columns)!s:.200}; add "
            f"{', '.join(absent)}"
        )


def frame_numbers(columns: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    """(n,) int64 of the column `frame`, each once.

    Raises:
        DataError: One is no frame number, or stands twice.
    """
    frames = columns["frame"]
    bad = np.flatnonzero((frames < 0) | (frames != np.floor(frames)) | (frames >= 1e10))
    if len(bad):
        raise DataError(f"{path}, row {int(bad[0]) + 2}: expected a frame number, found {frames[bad[0]]:g}")
    whole = frames.astype(np.int64)
    names, count = np.unique(whole, return_counts=True)
    if (count > 1).any():
        raise DataError(f"{path}: expected each frame once, found {names[count > 1][0]} again")
    return whole


def read_times(path: Path) -> dict[int, float]:
    """Frame to seconds, of a table with the columns `frame` and `time_s`.

    Raises:
        DataError: See `read_columns`; or frames or times do not ascend.
    """
    columns = read_columns(path)
    require_columns(columns, ("frame", "time_s"), path)
    frames = frame_numbers(columns, path)
    require_ascending(columns["time_s"], str(path))
    require_ascending(frames.astype(np.float64), f"{path}, column frame")
    return dict(zip(frames.tolist(), columns["time_s"].tolist(), strict=True))


def read_pose_table(path: Path) -> tuple[PosePath, np.ndarray | None]:
    """The poses of `poses.csv`, and the frame (n,) of each, or None without that column.

    A row is `time_s` and either `x, y, z, qx, qy, qz, qw` or the upper three rows `m00` to `m23` of a matrix.

    Raises:
        DataError: See `read_columns`; or a pose is no rotation with a place on Earth.
    """
    columns = read_columns(path)
    if "m00" in columns:
        require_columns(columns, ("time_s", *_MATRIX), path)
        values = np.stack([columns[name] for name in _MATRIX], axis=1)
    else:
        require_columns(columns, ("time_s", *_PLACE, *_QUATERNION), path)
        values = _matrices(columns, path)
    require_ascending(columns["time_s"], str(path))
    poses = []
    for number, row in enumerate(values, start=2):
        try:
            poses.append(rigid(row, FARTHEST_M))
        except ValueError as error:
            raise DataError(f"{path}, row {number}: {error}; correct it, or delete the row") from error
    frames = frame_numbers(columns, path) if "frame" in columns else None
    return PosePath(columns["time_s"], np.stack(poses), path), frames


def _matrices(columns: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    """(n, 12) upper rows of poses of a place and a quaternion."""
    quaternion = np.stack([columns[name] for name in _QUATERNION], axis=1)
    short = np.flatnonzero(np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 0.01)
    if len(short):
        raise DataError(
            f"{path}, row {int(short[0]) + 2}: expected a quaternion of length 1, found "
            f"{quaternion[short[0]].tolist()}; their order is qx, qy, qz, qw"
        )
    rotation = Rotation.from_quat(quaternion).as_matrix()
    place = np.stack([columns[name] for name in _PLACE], axis=1)
    return np.concatenate([rotation, place[:, :, None]], axis=2).reshape(-1, 12)


def read_box_table(path: Path, frames: range) -> tuple[list[Box], list[str]]:
    """Boxes of `boxes.csv` that are static or of these frames, and a reason for each that was left out.

    A row is `frame` (-1 = static), `object_id`, `label`, `dynamic` (0, 1), the middle's `x, y, z, qx, qy, qz,
    qw` in the world, and `length, width, height` in metres.

    Raises:
        DataError: See `read_columns`; or a column is absent.
    """
    # A drive without objects has no rows.
    columns = read_columns(path, ("label",), fewest_rows=0)
    numbers = ("frame", "object_id", "dynamic", *_PLACE, *_QUATERNION, *_SIZE)
    require_columns(columns, ("label", *numbers), path)
    if len(columns["frame"]) == 0:
        return [], []
    rows = _matrices(columns, path)
    boxes, left_out = [], []
    for k, row in enumerate(rows):
        frame = int(columns["frame"][k])
        if frame != STATIC_FRAME and frame not in frames:
            continue
        if not 0 <= columns["object_id"][k] <= _MOST_ID:
            found = columns["object_id"][k]
            left_out.append(
                f"row {k + 2} of {path.name}: expected object_id 0 to {_MOST_ID}, found {found:g}"
            )
            continue
        sides_m = np.array([columns[name][k] for name in _SIZE])
        if not ((sides_m > 1e-3) & (sides_m < 1e3)).all():
            left_out.append(f"row {k + 2} of {path.name}: expected sides of 1 mm to 1 km, found {sides_m}")
            continue
        matrix = np.eye(4)
        matrix[:3] = row.reshape(3, 4)
        matrix[:3, :3] *= sides_m
        boxes.append(
            Box(
                frame=frame, object_id=int(columns["object_id"][k]), label=str(columns["label"][k]),
                dynamic=bool(columns["dynamic"][k]), box_to_world=matrix,
            )
        )  # fmt: skip
    return boxes, left_out
