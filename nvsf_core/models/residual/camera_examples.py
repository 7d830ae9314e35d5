"""Training images of a camera as views that its other images render."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.models.holdout import validation_numbers
from nvsf_core.models.residual.pose_refinement import AlignedDrive
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.camera_view import CameraView, ShownImages, camera_view
from nvsf_core.rendering.learned_warp import coarse_colour
from nvsf_core.rendering.lidar_view import LidarView, MovingPoints, lidar_view
from nvsf_core.rendering.view_depth_maps import DepthMaps
from nvsf_core.rendering.warping import to_float

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
    """(3, h, w) float32 in 0..1, at the size at which depth planes are compared."""
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
    images: ShownImages
    """All training images, as sources."""
    spec: CameraSpec
    """Of the recipe."""
    returns: dict[int, tuple[list[MovingPoints], LidarView]] = field(default_factory=dict)
    """What is known already of `_returns`, for all views of an image by this drive's poses."""

    @property
    def validation(self) -> range:
        """Numbers of the training images that are for validation; at least one, never all."""
        return validation_numbers(len(self.images.full), self.spec.judge_every, self.spec.judge_every // 3)

    @property
    def training(self) -> list[int]:
        """Numbers of the other images."""
        return [index for index in range(len(self.images.full)) if index not in self.validation]

    def with_depths(self, maps: DepthMaps) -> "ShownCamera":
        """The same camera, whose images have depth maps."""
        return replace(self, images=self.images.with_depths(maps))

    def itself(self, index: int) -> LeftOut:
        """An image among its own sources, by which its depth is found; images for validation are none."""
        return self._with_truth(self.view(index, set(self.validation) - {index}, own=index), index)

    def left_out(self, index: int) -> LeftOut:
        """An image rendered from all others."""
        return self._with_truth(self.view(index, {index}), index)

    def left_out_in_block(self, index: int, place: int) -> LeftOut:
        """An image rendered from those beyond a distance, another one at each place among the views."""
        block = self._block(index, _BLOCKS_M[place % len(_BLOCKS_M)])
        return self._with_truth(self.view(index, block), index)

    def view(self, index: int, leave_out: Collection[int], own: int | None = None) -> CameraView:
        """The view of a training image by the others; the scan of its instant is known to their depths alone.

        Args:
            index: Number of the image.
            leave_out: Numbers of images that are no sources.
            own: As in `camera_view`.
        """
        shown = self.drive.world.recording.cameras[self.name].training
        pose = self.drive.left_out_pose(self.name, index)
        moving, lidar = self._returns(index)
        view = camera_view(
            pose, shown.pinhole, lidar, self.images, shown.pose, self.spec, leave_out=leave_out, own=own,
            moving=moving,
        )  # fmt: skip
        return view.to(self.images.full.device)

    def _returns(self, index: int) -> tuple[list[MovingPoints], LidarView]:
        """Moving objects at an image's instant, and what returns show in it; computed once."""
        found = self.returns.get(index)
        if found is None:
            world = self.drive.world
            one = world.recording.cameras[self.name]
            time_s, pose = float(one.training_time_s[index]), self.drive.left_out_pose(self.name, index)
            moving = world.moving(time_s, one.training_time_s, leave_out=True)
            static_m = world.static_points(time_s, leave_out=True)
            found = moving, lidar_view(pose, one.training.pinhole, static_m, moving)
            self.returns[index] = found
        return found

    def _with_truth(self, view: CameraView, index: int) -> LeftOut:
        truth = self.drive.given.cameras[self.name].training.rgb[index]
        small = functional.avg_pool2d(to_float(truth[None]), view.factor)[0]
        coarse = None if view.surfaces is None else coarse_colour(view)
        example = LeftOut(view, torch.from_numpy(truth).permute(2, 0, 1), small, coarse)
        return example.to(self.images.full.device)

    def _block(self, index: int, radius_m: float) -> set[int]:
        """Numbers of the images within a distance of one of them, which is one; at least two are left."""
        position_m = self.drive.world.recording.cameras[self.name].training.pose[:, :3, 3]
        distance_m = np.linalg.norm(position_m - position_m[index], axis=1)
        distance_m[index] = -1.0
        order = np.argsort(distance_m, kind="stable")
        inside = int(np.count_nonzero(distance_m <= radius_m))
        return set(order[: max(1, min(inside, len(order) - _FEWEST_SOURCES))].tolist())
