"""A drive whose images lie where they agree with each other, and where a view then is that they show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.rendering.image_alignment import PoseCorrection, align_images
from nvsf_core.stages.moving_things import MovingWorld
from nvsf_core.stages.recording import Recording


@dataclass(frozen=True, slots=True)
class AlignedDrive:
    """What the learned camera knows of a drive."""

    given: Recording
    """With the poses as they were recorded."""
    world: MovingWorld
    """With the images' corrected ones."""
    corrections: Mapping[str, PoseCorrection]
    """By camera; one that is not named keeps its poses."""

    def pose_at(self, camera: str, pose: np.ndarray, time_s: float) -> np.ndarray:
        """Where a view (4, 4) of any time lies among the corrected images."""
        correction = self.corrections.get(camera)
        return pose if correction is None else correction.at(pose, time_s)

    def left_out_pose(self, camera: str, index: int) -> np.ndarray:
        """Where a training image (4, 4) were looked for if it were held out: its own word is not heard."""
        one = self.given.cameras[camera]
        correction, pose = self.corrections.get(camera), one.training.pose[index]
        if correction is None:
            return pose
        return correction.at(pose, float(one.training_time_s[index]), leave_out=index)


def align_drive(recording: Recording, cameras: Sequence[str]) -> AlignedDrive:
    """Align the images of the named cameras, each camera's by themselves; without a LiDAR none are."""
    if recording.lidar is None:
        return aligned_by(recording, {})
    world = MovingWorld(recording)
    corrections = {}
    for name in cameras:
        one = recording.cameras[name]
        returns_m = [world.still_points(float(time_s), most=1) for time_s in one.training_time_s]
        twist = align_images(one.training.rgb, one.training.pinhole, one.training.pose, returns_m)
        corrections[name] = PoseCorrection(one.training_time_s, twist)
    return aligned_by(recording, corrections)


def aligned_by(recording: Recording, corrections: Mapping[str, PoseCorrection]) -> AlignedDrive:
    """The drive with corrections that are known."""
    cameras = dict(recording.cameras)
    for name, correction in corrections.items():
        training = cameras[name].training
        aligned = replace(training, pose=correction.of_images(training.pose))
        cameras[name] = replace(cameras[name], training=aligned)
    return AlignedDrive(recording, MovingWorld(replace(recording, cameras=cameras)), corrections)


def facts_of(corrections: Mapping[str, PoseCorrection]) -> dict[str, dict[str, object]]:
    """Corrections as JSON can hold them."""
    return {
        name: {"time_s": one.time_s.tolist(), "twist": one.twist.tolist()}
        for name, one in corrections.items()
    }


def corrections_from(facts: Mapping[str, Mapping[str, object]]) -> dict[str, PoseCorrection]:
    """What `facts_of` said."""
    return {
        name: PoseCorrection(np.array(one["time_s"], np.float64), np.array(one["twist"], np.float64))
        for name, one in facts.items()
    }
