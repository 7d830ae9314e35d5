"""Training images of a camera as views that the other images render."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.models.holdout import validation_numbers
from nvsf_core.models.residual.exposures import Exposures
from nvsf_core.models.residual.pose_refinement import AlignedDrive
from nvsf_core.models.residual.shared_images import SharedImages
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.camera_view import CameraView, ShownImages, camera_view
from nvsf_core.rendering.image_exposure import recorded_at_exposure
from nvsf_core.rendering.learned_warp import coarse_colour
from nvsf_core.rendering.lidar_view import LidarView, MovingPoints, lidar_view

_BLOCKS_M = (1.0, 2.0, 4.0)
"""An image is also rendered without those within one of these distances: networks learn to look from afar."""
_FEWEST_SOURCES = 2


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A training image, and the view of it that is compared with, or rendered from, the other images."""

    view: CameraView
    """The inputs of the view, without the scan of its instant, and to draw it without the image itself."""
    truth: Tensor
    """(3, H, W) uint8."""
    small_truth: Tensor
    """(3, h, w) float32 in 0..1, at the size at which depth planes are compared, and the common exposure."""
    coarse: Tensor | None = None
    """(3, h, w) of `coarse_colour`; None while images have no depths."""

    def to(self, device: torch.device) -> "LeftOut":
        """The same example on `device`."""
        truth, small = self.truth.to(device), self.small_truth.to(device)
        coarse = None if self.coarse is None else self.coarse.to(device)
        return LeftOut(self.view.to(device), truth, small, coarse)


@dataclass(frozen=True, slots=True)
class ShownCamera:
    """A camera's training images, and their views by each other."""

    drive: AlignedDrive
    """With the images' poses."""
    name: str
    """Of the camera."""
    shared: SharedImages
    """Its training images and those of the cameras that share theirs with it."""
    images: ShownImages
    """All of these, as sources."""
    spec: CameraSpec
    """Of the recipe."""
    exposures: Exposures | None = None
    """Of the camera; None = fixed."""
    returns: dict[int, tuple[list[MovingPoints], LidarView]] = field(default_factory=dict)
    """What is known already of `_returns`, for all views of an image by this drive's poses."""

    @property
    def validation(self) -> range:
        """Which of its own training images are for validation; at least one, never all."""
        return validation_numbers(self.shared.count, self.spec.judge_every, self.spec.judge_every // 3)

    @property
    def training(self) -> list[int]:
        """Which are not."""
        return [index for index in range(self.shared.count) if index not in self.validation]

    @property
    def for_validation(self) -> set[int]:
        """Numbers of all shared images that are for validation."""
        return {number for index in self.validation for number in self.shared.at_instant_of(index)}

    def itself(self, index: int) -> LeftOut:
        """One of its images among its own sources, by which its depth is found.

        Images for validation are no sources.
        """
        number = self.shared.number(self.name, index)
        return self._with_truth(self._view(index, self.for_validation - {number}, own=number), index)

    def left_out(self, index: int) -> LeftOut:
        """One of its images rendered from all of other instants."""
        return self._with_truth(self._view(index, self.shared.at_instant_of(index)), index)

    def left_out_in_block(self, index: int, place: int) -> LeftOut:
        """One of its images rendered from those beyond a distance, which alternates with `place`."""
        block = self._block(index, _BLOCKS_M[place % len(_BLOCKS_M)])
        return self._with_truth(self._view(index, block), index)

    def from_others(self, index: int, *, alone: bool = False) -> CameraView:
        """The view of one of its images by all of other instants, whose exposures give its own.

        `alone`: by its own camera's images only.
        """
        not_own = self.shared.of_others(self.name) if alone else set()
        view = self._view(index, self.shared.at_instant_of(index) | not_own)
        return replace(view, log_gain=self._log_gain(index, leave_out=True))

    def _view(self, index: int, leave_out: Collection[int], own: int | None = None) -> CameraView:
        """The view of one of its images; the scan of its instant is known to the others' depths alone.

        Args:
            index: Of the image among its own.
            leave_out: Numbers of shared images that are no sources.
            own: As in `camera_view`.
        """
        recording = self.drive.world.recording
        pose = self.drive.left_out_pose(self.name, index)
        moving, lidar = self._returns(index)
        view = camera_view(
            pose, recording.cameras[self.name].training.pinhole, lidar, self.images,
            self.shared.poses(recording), self.spec, instant=self.shared.instant, leave_out=leave_out,
            own=own, moving=moving,
        )  # fmt: skip
        return replace(view, log_gain=self._log_gain(index)).to(self.images.full.device)

    def _log_gain(self, index: int, *, leave_out: bool = False) -> float:
        """Of one of its images; `leave_out`: as the others tell it."""
        if self.exposures is None:
            return 0.0
        time_s = self.drive.world.recording.cameras[self.name].training_time_s[index]
        return self.exposures.at(float(time_s), leave_out=leave_out)

    def _returns(self, index: int) -> tuple[list[MovingPoints], LidarView]:
        """Moving objects at an image's instant, and what returns show in it; computed once."""
        found = self.returns.get(index)
        if found is None:
            world = self.drive.world
            one = world.recording.cameras[self.name]
            time_s, pose = float(one.training_time_s[index]), self.drive.left_out_pose(self.name, index)
            moving = world.moving(time_s, self.shared.times_s(world.recording), leave_out=True)
            static_m = world.static_points(time_s, leave_out=True)
            found = moving, lidar_view(pose, one.training.pinhole, static_m, moving)
            self.returns[index] = found
        return found

    def _with_truth(self, view: CameraView, index: int) -> LeftOut:
        truth = self.drive.given.cameras[self.name].training.rgb[index]
        small = functional.avg_pool2d(recorded_at_exposure(truth, -view.log_gain), view.factor)
        coarse = None if view.surfaces is None else coarse_colour(view)
        example = LeftOut(view, torch.from_numpy(truth).permute(2, 0, 1), small, coarse)
        return example.to(self.images.full.device)

    def _block(self, index: int, radius_m: float) -> set[int]:
        """Numbers of the images of its instant and within a distance of it; at least two are left."""
        position_m = self.shared.poses(self.drive.world.recording)[:, :3, 3]
        number, instant = self.shared.number(self.name, index), list(self.shared.at_instant_of(index))
        distance_m = np.linalg.norm(position_m - position_m[number], axis=1)
        distance_m[instant] = -1.0
        order = np.argsort(distance_m, kind="stable")
        inside = int(np.count_nonzero(distance_m <= radius_m))
        return set(order[: max(len(instant), min(inside, len(order) - _FEWEST_SOURCES))].tolist())
