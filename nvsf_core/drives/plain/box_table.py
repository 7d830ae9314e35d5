"""Reading of a plain drive's `boxes.csv`: labelled boxes, by which moving objects are scored."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.boxes import STATIC_FRAME, Box
from nvsf_core.drives.kitti360.text import FARTHEST_M
from nvsf_core.drives.plain.tables import finite_number, read_rows
from nvsf_core.errors import DataError

_PLACE, _QUATERNION, _SIZE = ("x", "y", "z"), ("qx", "qy", "qz", "qw"), ("length", "width", "height")
_NUMBERS = ("frame", "object_id", "dynamic", *_PLACE, *_QUATERNION, *_SIZE)
_MOST_ID = 2**31 - 1


def read_box_table(path: Path, frames: range, drive: range) -> tuple[list[Box], list[str]]:
    """Boxes of `boxes.csv` that are static or of these frames, and a reason for each that was left out.

    Those of other frames of the whole `drive` are passed over.

    A row is `frame` (-1 = static), `object_id`, `label`, `dynamic` (0, 1), the middle's `x, y, z, qx, qy, qz,
    qw` in the world, and `length, width, height` in metres. A drive is trained without its boxes, so a row
    that cannot be used is left out and named.

    Raises:
        DataError: The table cannot be read, or a column is absent.
    """
    names, rows = read_rows(path)
    absent = [name for name in ("label", *_NUMBERS) if name not in names]
    if absent:
        raise DataError(
            f"{path}: expected columns label, {', '.join(_NUMBERS)}, found {', '.join(names)!s:.200}; add "
            f"{', '.join(absent)}, or remove the file: boxes are for scoring alone"
        )
    boxes: list[Box] = []
    left_out: list[str] = []
    for number, cells in rows:
        try:
            box = _box(_by_name(names, cells), frames, drive)
        except ValueError as error:
            left_out.append(f"line {number} of {path.name}: {error}")
            continue
        boxes += [] if box is None else [box]
    return boxes, left_out


def _by_name(names: list[str], cells: list[str]) -> dict[str, str]:
    if len(cells) != len(names):
        raise ValueError(f"expected {len(names)} cells, found {len(cells)}")
    return dict(zip(names, cells, strict=True))


def _box(row: Mapping[str, str], frames: range, drive: range) -> Box | None:
    """The box of a row; None if it is of another frame of the drive.

    Raises:
        ValueError: A cell is not what its column holds; the message names the column.
    """
    frame = _whole(row, "frame", STATIC_FRAME, 10**10 - 1)
    if frame != STATIC_FRAME and frame not in frames:
        if frame not in drive:
            raise ValueError(
                f"frame: expected {STATIC_FRAME}, or one of the drive's, {drive.start} to {drive.stop - 1}, "
                f"found {frame}"
            )
        return None
    object_id, dynamic = _whole(row, "object_id", 0, _MOST_ID), _whole(row, "dynamic", 0, 1)
    if frame == STATIC_FRAME and dynamic:
        raise ValueError(f"dynamic: expected 0 of a static box (frame {STATIC_FRAME}), found 1")
    place_m = np.array([_number(row, name) for name in _PLACE])
    if np.abs(place_m).max() > FARTHEST_M:
        raise ValueError(f"x, y, z: expected a place within {FARTHEST_M:g} m, found {place_m.tolist()}")
    quaternion = np.array([_number(row, name) for name in _QUATERNION])
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 0.01:
        raise ValueError(f"qx, qy, qz, qw: expected a quaternion of length 1, found {quaternion.tolist()}")
    sides_m = np.array([_number(row, name) for name in _SIZE])
    if not ((sides_m > 1e-3) & (sides_m < 1e3)).all():
        raise ValueError(f"length, width, height: expected 1 mm to 1 km, found {sides_m.tolist()}")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix() * sides_m
    matrix[:3, 3] = place_m
    return Box(
        frame=frame, object_id=object_id, label=row["label"].strip(), dynamic=bool(dynamic),
        box_to_world=matrix,
    )  # fmt: skip


def _number(row: Mapping[str, str], name: str) -> float:
    try:
        return finite_number(row[name])
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _whole(row: Mapping[str, str], name: str, least: int, most: int) -> int:
    value = _number(row, name)
    if value != int(value) or not least <= value <= most:
        raise ValueError(f"{name}: expected a whole number {least} to {most}, found {value:g}")
    return int(value)
