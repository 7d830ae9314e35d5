"""Reading of the car's poses: `poses.txt`, and `cam0_to_world.txt` to check them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.layout import LAST_FRAME
from nvsf_core.drives.kitti360.text import FARTHEST_M, MIB, parse_numbers, read_text, rigid
from nvsf_core.errors import DataError

_MOST_LINES, _MOST_BYTES = 100_000, 32 * MIB
"""The longest drive of KITTI-360 has 15,000 frames, in 4 MB."""


def read_poses(path: Path) -> dict[int, np.ndarray]:
    """Read `poses.txt`: for each frame number (4, 4) float64, pose frame to world.

    Frames without a line are not in the result (KITTI-360 has none where the car hardly moved).

    Raises:
        DataError: The file is absent, or a line cannot be read; file, line and remedy are named.
    """
    return _read_lines(path, 12)


def read_cam0_to_world(path: Path) -> dict[int, np.ndarray]:
    """Read `cam0_to_world.txt`: for each frame number (4, 4) float64, rectified camera 0 to world.

    Raises:
        DataError: The file is absent, or a line cannot be read; file, line and remedy are named.
    """
    return _read_lines(path, 16)


@dataclass(frozen=True, slots=True)
class PoseDisagreement:
    """Largest difference between two sources of the same poses."""

    frames: int
    """Number of frames with a pose in both."""
    translation_m: float
    rotation_deg: float


def compare_poses(left: dict[int, np.ndarray], right: dict[int, np.ndarray]) -> PoseDisagreement:
    """Largest distance and largest angle between two tables of poses (4, 4), over their common frames."""
    common = sorted(left.keys() & right.keys())
    if not common:
        return PoseDisagreement(0, float("nan"), float("nan"))
    a = np.stack([left[frame] for frame in common])
    b = np.stack([right[frame] for frame in common])
    shift_m = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    # |A - B| = 2 sqrt(2) sin(angle / 2): well conditioned near 0, where the trace formula is not.
    chord = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2)) / np.sqrt(8.0)
    angle_rad = 2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))
    return PoseDisagreement(len(common), float(shift_m.max()), float(np.degrees(angle_rad.max())))


def _read_lines(path: Path, count: int) -> dict[int, np.ndarray]:
    """Poses (4, 4) by frame number, from lines of a frame number and `count` matrix entries."""
    try:
        text = read_text(path, _MOST_BYTES)
    except (OSError, ValueError) as error:
        raise DataError(
            f"cannot read poses {path} ({error}); unpack the drive's `data_poses` folder there"
        ) from error
    if text.count("\n") > _MOST_LINES:
        raise DataError(
            f"{path}: expected at most {_MOST_LINES:,} lines, found more; cut the drive into parts"
        )
    poses: dict[int, np.ndarray] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            values = parse_numbers(line, count + 1)
            frame = _frame_number(values[0])
            if frame in poses:
                raise ValueError(f"frame {frame} has a pose already")
            if count == 16 and np.abs(values[13:] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
                raise ValueError(f"frame {frame}: expected the last row 0 0 0 1, found {values[13:]}")
            poses[frame] = _pose(frame, values[1:13])
        except ValueError as error:
            raise DataError(
                f"{path}, line {number}: {error} (a line is: frame number, {count} matrix entries); "
                "restore the file of the drive, or delete the line: its frame is then left out"
            ) from error
    return poses


def _pose(frame: int, values: np.ndarray) -> np.ndarray:
    try:
        return rigid(values, FARTHEST_M)
    except ValueError as error:
        raise ValueError(f"frame {frame}: {error}") from error


def _frame_number(value: float) -> int:
    if not 0 <= value <= LAST_FRAME or value != int(value):
        raise ValueError(f"expected a frame number, found {value}")
    return int(value)
