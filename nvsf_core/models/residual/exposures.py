"""Exposures of a camera's training images, and of a view at any time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.rendering.image_exposure import log_gains, recorded_at_exposure

_SAME = 0.02
"""A camera's exposure is fixed where no logarithm of a gain is farther from a straight line along the drive.
A line is no exposure: what comes nearer looks a little darker or brighter each time."""


@dataclass(frozen=True, slots=True)
class Exposures:
    """Exposures of one camera."""

    time_s: np.ndarray
    """(n,) ascending, seconds: instants of the training images."""
    log_gain: np.ndarray
    """(n,) natural logarithm of each image's gain over the camera's common exposure."""

    def at(self, time_s: float, *, leave_out: bool = False) -> float:
        """The logarithm of the gain at any time, between those of the images before and after it.

        Args:
            time_s: Before the first and after the last image theirs hold.
            leave_out: Ignore the image of exactly that time.
        """
        used = self.time_s != time_s if leave_out and len(self.time_s) > 1 else np.ones(1, np.bool_)
        used = np.broadcast_to(used, self.time_s.shape)
        return float(np.interp(time_s, self.time_s[used], self.log_gain[used]))


def exposures_of(world: MovingWorld, cameras: Sequence[str]) -> dict[str, Exposures]:
    """By name, the exposures of those of the cameras whose exposure changes; none without a LiDAR."""
    if world.recording.lidar is None:
        return {}
    found = {}
    for name in cameras:
        one = world.recording.cameras[name]
        returns_m = [world.own_returns(frame) for frame in one.training_frame.tolist()]
        gains = log_gains(one.training.rgb, one.training.pinhole, one.training.pose, returns_m)
        if np.abs(gains - _line(one.training_time_s, gains)).max() > _SAME:
            found[name] = Exposures(one.training_time_s, gains)
    return found


def evened(exposures: Exposures | None, rgb: np.ndarray, index: int) -> np.ndarray:
    """A training image (h, w, 3) of `rgb` (n, h, w, 3) uint8, levels 0..255, at the common exposure.

    Without exposures, which are then fixed, it is returned as it is.
    """
    if exposures is None:
        return rgb[index]
    levels = recorded_at_exposure(rgb[index], -float(exposures.log_gain[index]))
    return 255.0 * levels.permute(1, 2, 0).numpy()


def _line(time_s: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """The straight line (n,) through values (n,) at times (n,), by least squares."""
    design = np.stack([np.ones_like(time_s), time_s - time_s.mean()], axis=1)
    return design @ np.linalg.lstsq(design, gains, rcond=None)[0]
