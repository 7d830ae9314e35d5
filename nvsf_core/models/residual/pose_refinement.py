"""Corrects camera poses so that LiDAR returns look alike in neighbouring images, and views with them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.exposures import Exposures, evened
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.image_alignment import PoseCorrection, align_images


@dataclass(frozen=True, slots=True)
class AlignedDrive:
    """A drive with its recorded and with its corrected camera poses."""

    given: Recording
    """With the recorded poses."""
    world: MovingWorld
    """With the corrected poses."""
    corrections: Mapping[str, PoseCorrection]
    """By camera; the poses of a camera that is not named are not corrected."""

    def pose_at(self, camera: str, pose: np.ndarray, time_s: float) -> np.ndarray:
        """The corrected pose (4, 4), camera to scene-local, of a view at a time, by a camera's corrections.

        The view is moved with the recording camera of its time, seconds since the first frame, as if both
        were fixed to one vehicle: the correction is expressed in that camera's frame, not in the view's.
        """
        correction = self.corrections.get(camera)
        if correction is None:
            return pose
        # An image may be taken after the last frame: then its recording camera is at the end of the path.
        path = self.given.trajectory
        rotation, position = path.at(np.clip([time_s], path.times_s[0], path.times_s[-1]))
        # A mounting read from a file is a rotation only up to 1e-10, so its inverse is not its transpose.
        recorded = pose_from_parts(rotation[0], position[0]) @ self.given.cameras[camera].in_lidar
        return correction.at(recorded, time_s) @ (np.linalg.inv(recorded) @ pose)

    def left_out_pose(self, camera: str, index: int) -> np.ndarray:
        """The corrected pose (4, 4) of a training image, from the other images' corrections alone."""
        one = self.given.cameras[camera]
        correction, pose = self.corrections.get(camera), one.training.pose[index]
        if correction is None:
            return pose
        return correction.at(pose, float(one.training_time_s[index]), leave_out=True)


def align_drive(
    world: MovingWorld,
    cameras: Sequence[str],
    left_out: Mapping[str, Collection[int]] | None = None,
    exposures: Mapping[str, Exposures] | None = None,
) -> dict[str, PoseCorrection]:
    """Correct the poses of the named cameras, each camera by itself; without a LiDAR nothing is corrected.

    Args:
        world: The drive with its recorded poses.
        cameras: Names.
        left_out: By camera, numbers of training images that take no part.
        exposures: By camera; the exposure of one that is not named is fixed.
    """
    if world.recording.lidar is None:
        return {}
    corrections = {}
    for name in cameras:
        one = world.recording.cameras[name]
        unused = () if left_out is None else left_out.get(name, ())
        used = [index for index in range(len(one.training.rgb)) if index not in unused]
        time_s = one.training_time_s[used]
        returns_m = [world.own_returns(frame) for frame in one.training_frame[used].tolist()]
        exposed = None if exposures is None else exposures.get(name)
        images = (evened(exposed, one.training.rgb, index) for index in used)
        twist = align_images(images, one.training.pinhole, one.training.pose[used], returns_m)
        corrections[name] = PoseCorrection(time_s, twist)
    return corrections


def aligned_by(world: MovingWorld, corrections: Mapping[str, PoseCorrection]) -> AlignedDrive:
    """Apply known corrections to a drive."""
    given = world.recording
    if not corrections:
        return AlignedDrive(given, world, corrections)
    cameras = dict(given.cameras)
    for name, correction in corrections.items():
        one = cameras[name]
        pose = correction.of_images(one.training.pose, one.training_time_s)
        cameras[name] = replace(one, training=replace(one.training, pose=pose))
    return AlignedDrive(given, MovingWorld(replace(given, cameras=cameras)), corrections)


_Timed = TypeVar("_Timed", PoseCorrection, Exposures)


def facts_of(known: Mapping[str, _Timed]) -> dict[str, dict[str, object]]:
    """Corrections, or exposures, by camera, as plain JSON values."""
    return {name: {key: getattr(one, key).tolist() for key in one.__slots__} for name, one in known.items()}


def from_facts(kind: type[_Timed], facts: Mapping[str, Mapping[str, object]]) -> dict[str, _Timed]:
    """Corrections, or exposures, from the values of `facts_of`."""
    return {
        name: kind(**{key: np.array(values, np.float64) for key, values in one.items()})
        for name, one in facts.items()
    }
