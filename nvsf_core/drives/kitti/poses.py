"""KITTI's poses: `poses/XX.txt` of the odometry benchmark, and `oxts` packets of raw drives."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.drives.kitti360.text import FARTHEST_M, MIB, parse_numbers, read_text, rigid
from nvsf_core.errors import DataError

_MOST_BYTES = 64 * MIB
EARTH_RADIUS_M = 6_378_137.0
"""Of the development kit's Mercator projection."""
_OXTS_NUMBERS = 30


def read_poses(path: Path) -> np.ndarray:
    """Poses (n, 4, 4) float64 of a file with the upper three rows of a matrix a line.

    Raises:
        DataError: It is absent, or a line is none; file and line are named.
    """
    return np.array(_each(path, lambda line: rigid(parse_numbers(line, 12), FARTHEST_M))).reshape(-1, 4, 4)


def read_seconds(path: Path) -> np.ndarray:
    """Seconds (n,) of a file with a number a line.

    Raises:
        DataError: It is absent, or a line is none.
    """
    return np.array(_each(path, lambda line: float(parse_numbers(line, 1)[0])))


def read_oxts(path: Path) -> np.ndarray:
    """Latitude, longitude (degrees), altitude (m), roll, pitch, yaw (rad) of one packet, (6,) float64.

    Raises:
        DataError: It is absent or is no packet of 30 numbers.
    """
    lines = _lines(path)
    try:
        numbers = parse_numbers(lines[0] if lines else "", _OXTS_NUMBERS)
    except ValueError as error:
        raise DataError(f"{path}: {error} (an oxts packet); restore the file") from error
    if abs(numbers[0]) > 85.0 or abs(numbers[1]) > 360.0:
        raise DataError(f"{path}: expected degrees of latitude and longitude, found {numbers[:2]}")
    return numbers[:6]


def oxts_poses(packets: np.ndarray) -> np.ndarray:
    """IMU to world (n, 4, 4) of packets (n, 6): metres east, north and up of a Mercator map.

    x = s R lon, y = s R log tan(pi / 4 + lat / 2), with s = cos(latitude of the first packet); the rotation
    is Rz(yaw) Ry(pitch) Rx(roll). Source: KITTI raw's development kit, `convertOxtsToPose`.
    """
    latitude, longitude = np.radians(packets[:, 0]), np.radians(packets[:, 1])
    scale = np.cos(latitude[0]) * EARTH_RADIUS_M
    poses = np.tile(np.eye(4), (len(packets), 1, 1))
    poses[:, 0, 3] = scale * longitude
    poses[:, 1, 3] = scale * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    poses[:, 2, 3] = packets[:, 2]
    for k, (roll, pitch, yaw) in enumerate(packets[:, 3:]):
        poses[k, :3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    return poses


def _about(axis: int, angle_rad: float) -> np.ndarray:
    turn, (first, second) = np.eye(3), [(1, 2), (2, 0), (0, 1)][axis]
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    turn[first, first] = turn[second, second] = cosine
    turn[first, second], turn[second, first] = -sine, sine
    return turn


def _each(path: Path, read: Callable[[str], Any]) -> list[Any]:
    """What `read` makes of each line."""
    found = []
    for number, line in enumerate(_lines(path), start=1):
        try:
            found.append(read(line))
        except ValueError as error:
            raise DataError(f"{path}, line {number}: {error}; restore the file") from error
    return found


def _lines(path: Path) -> list[str]:
    try:
        text = read_text(path, _MOST_BYTES)
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path} ({error}); unpack the drive again") from error
    return [line for line in text.splitlines() if line.strip()]
