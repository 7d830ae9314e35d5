"""Where the camera of rectified images stands in the frame that its messages name.

By ROS's definition that frame is the camera's as it was built, which `R` turns to the rectified image's;
or, of a stereo pair's second camera, the first one's, from which the fourth column of `P` says where the
second one stands. Many drivers, as RealSense's, and kitti2bag give each camera a frame of its own instead,
as built or as rectified. Which of these it is, the fixed transforms between the frames show.
"""

import contextlib
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from nvsf_core.drives.bags.index import BagIndex
from nvsf_core.drives.bags.messages import info_numbers
from nvsf_core.drives.bags.transforms import plain_name
from nvsf_core.drives.kitti360.text import rotation
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.se3 import invert_pose, log_so3, pose_from_parts

_LONGEST_BASELINE_M = 10.0
"""Longest distance between two cameras of one car."""
_LEAST_BASELINE_M = 1e-3
_ALIKE = 0.05
"""Largest difference of a baseline by transforms from that of `P`, in baselines: mountings may be nominal."""
_PARALLEL_RAD = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class _Stereo:
    """What a camera info says of the rectified image's camera."""

    frame: str
    to_rectified: np.ndarray
    """(4, 4) turn from the camera as built, `R`."""
    centre_m: np.ndarray
    """(3,) place from the pair's first camera, in rectified axes, by the fourth column of `P`."""

    @classmethod
    def of(cls, info: Any, where: str) -> Self:
        """Read a camera info.

        Raises:
            CalibrationError: `R` is no rotation, or `P` puts the camera out of the car.
        """
        turn, p = info_numbers(info, "r"), info_numbers(info, "p")
        try:
            # Of a single camera many drivers leave it at 0.
            turned = rotation(turn.reshape(3, 3)) if turn.any() else np.eye(3)
        except ValueError as error:
            raise CalibrationError(f"{where}: R: {error}; correct the calibration") from error
        centre_m = np.zeros(3)
        if len(p) == 12 and p[0] > 0.0 and p[5] > 0.0:
            centre_m[:2] = -p[3] / p[0], -p[7] / p[5]
        if not np.linalg.norm(centre_m) <= _LONGEST_BASELINE_M:
            raise CalibrationError(
                f"{where}: P: expected a second camera within {_LONGEST_BASELINE_M:g} m of the first, found "
                f"it at {centre_m.tolist()} m by the fourth column; correct the calibration"
            )
        frame = plain_name(info.header.frame_id)
        return cls(frame, pose_from_parts(turned, np.zeros(3)), centre_m)


def rectified_place(index: BagIndex, topic: str, frame: str) -> np.ndarray:
    """(4, 4) camera of a rectified image in its message's frame, by `R` and `P` of its camera info.

    The identity where the fixed transforms hold `R` and `P` already: other cameras, or the pair's first, then
    lie from it where `P` says, with axes that are parallel.

    Raises:
        CalibrationError: `R` or `P` is unphysical.
    """
    own = _Stereo.of(index.infos[topic], topic)
    others = _others(index, topic)
    is_second = own.centre_m.any()
    first = next((one for one in others if is_second and one.frame == frame and not one.centre_m.any()), own)
    fixed = sorted({name for link in index.tree.fixed for name in link})
    unnamed = [_Stereo(one, np.eye(4), np.zeros(3)) for one in fixed]
    is_built = False
    for other in (*others, *unnamed):
        place = index.tree.between(other.frame, frame)
        if place is None:
            continue
        if _is_where_p_says(place, own, other):
            return np.eye(4)
        is_built |= _is_where_p_says(own.to_rectified @ place @ other.to_rectified.T, own, other)
    if is_built:
        return invert_pose(own.to_rectified)
    # Both images of a pair have the same axes.
    return invert_pose(first.to_rectified) @ pose_from_parts(np.eye(3), own.centre_m)


def place_words(place: np.ndarray) -> str:
    """How far a rectified camera (4, 4) stands from its frame, for notes."""
    turn_deg = np.degrees(np.linalg.norm(log_so3(place[:3, :3])))
    return f"stands {np.linalg.norm(place[:3, 3]):.3f} m and {turn_deg:.2f} degrees from"


def _others(index: BagIndex, topic: str) -> list[_Stereo]:
    """The other camera infos; those that cannot be are named where their own camera is read."""
    found = []
    for name, info in index.infos.items():
        with contextlib.suppress(CalibrationError):
            found += [_Stereo.of(info, name)] if name != topic else []
    return found


def _is_where_p_says(place: np.ndarray, own: _Stereo, other: _Stereo) -> bool:
    """Whether another camera's place (4, 4) in a camera's axes is by their rectified images' `P`."""
    apart_m = other.centre_m - own.centre_m
    baseline_m = float(np.linalg.norm(apart_m))
    is_near = float(np.linalg.norm(place[:3, 3] - apart_m)) <= _ALIKE * baseline_m
    is_parallel = float(np.linalg.norm(log_so3(place[:3, :3]))) <= _PARALLEL_RAD
    return baseline_m > _LEAST_BASELINE_M and is_near and is_parallel
