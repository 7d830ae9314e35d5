"""Reading of a user's file of poses: the path of a view."""

from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.text import MIB, read_text
from nvsf_core.drives.view_parts import PoseFile
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import pose_from_parts

_MOST_BYTES = 64 * MIB
_QUATERNION, _MATRIX = 8, 13
"""Numbers of a line: seconds with position and quaternion, or with a 3 x 4 matrix."""
_TOLERANCE = 1e-3
_LENGTH_TOLERANCE = 0.01
"""Of a quaternion of few digits, as in `poses.csv` of a drive."""


def read_pose_file(path: Path) -> PoseFile:
    """The poses of a text file: a line a pose; empty lines and those that begin with `#` are left out.

    Args:
        path: The file. A line has 8 numbers (seconds, x y z, quaternion x y z w: the TUM format), or 13
            (seconds, then the upper three rows of the 4 x 4 matrix), apart by blanks or commas.

    Raises:
        DataError: It cannot be read, or a line is none of these, not finite, of a quaternion whose length is
            not 1, no rotation, or out of order; the message names file and line.
    """
    try:
        text = read_text(path, _MOST_BYTES)
    except (OSError, ValueError) as error:
        raise DataError(f"pose_file: cannot read {path} ({error})") from error
    times_s: list[float] = []
    poses: list[tuple[float, ...]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}:{number}"
        values = _numbers(words, where)
        pose = _of_quaternion(values[1:], where) if len(values) == _QUATERNION else values[1:].reshape(3, 4)
        rotation = pose[:, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_TOLERANCE) or np.linalg.det(rotation) < 0:
            raise DataError(
                f"{where}: expected a rotation, found {rotation.round(3).tolist()}; correct the line"
            )
        if times_s and values[0] <= times_s[-1]:
            raise DataError(f"{where}: expected ascending seconds, found {values[0]} after {times_s[-1]}")
        times_s.append(float(values[0]))
        poses.append(tuple(pose.reshape(-1).tolist()))
    if not poses:
        raise DataError(f"{path}: expected a pose a line, found none")
    return PoseFile(name=path.name, time_s=tuple(times_s), poses=tuple(poses))


def _numbers(words: list[str], where: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(f"{where}: expected numbers, found {' '.join(words):.60}") from error
    if len(values) not in (_QUATERNION, _MATRIX) or not np.isfinite(values).all():
        raise DataError(
            f"{where}: expected {_QUATERNION} finite numbers (seconds, x y z, quaternion x y z w) or "
            f"{_MATRIX} (seconds, 3 x 4 matrix), found {len(values)}: {' '.join(words):.60}"
        )
    return values


def _of_quaternion(values: np.ndarray, where: str) -> np.ndarray:
    """(3, 4) pose of x y z and a quaternion x y z w."""
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise DataError(
            f"{where}: expected a quaternion of length 1, found {values[3:].tolist()}; it is x, y, z, w"
        )
    x, y, z, w = values[3:] / length
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    pose: np.ndarray = pose_from_parts(rotation, values[:3])[:3]
    return pose
