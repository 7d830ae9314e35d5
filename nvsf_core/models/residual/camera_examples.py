"""Training images of a camera as views that the other images render."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

from torch import Tensor
from torch.nn import functional

from nvsf_core.models.holdout import validation_numbers
from nvsf_core.models.residual.exposures import Exposures
from nvsf_core.models.residual.pose_refinement import AlignedDrive
from nvsf_core.models.residual.shared_images import SharedImages
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.rendering.camera_view import CameraView, ShownImages, camera_view
from nvsf_core.rendering.image_exposure import recorded_at_exposure
from nvsf_core.rendering.lidar_view import LidarView, MovingPoints, lidar_view


@dataclass(frozen=True, slots=True)
class RecordedView:
    """A training image, and the view of it that is compared with the images around it."""

    view: CameraView
    """Without the scan of its instant."""
    truth: Tensor
    """(3, h, w) float32 in 0..1, at the size at which depth planes are compared, and the common exposure."""


@dataclass(frozen=True, slots=True)
class ShownCamera:
    """A camera's training images, and their views by each other."""

    drive: AlignedDrive
    """With the images' poses."""
    name: str
    shared: SharedImages
    """Its training images and those of the cameras that share theirs with it."""
    images: ShownImages
    """All of these, as sources."""
    spec: CameraSpec
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

    def itself(self, index: int) -> RecordedView:
        """One of its images among its own sources, by which its depth is found.

        Images for validation are no sources.
        """
        number = self.shared.number(self.name, index)
        view = self._view(index, self.for_validation, own=number)
        recorded = self.drive.given.cameras[self.name].training.rgb[index]
        levels = recorded_at_exposure(recorded, -self._log_gain(index))
        truth = functional.avg_pool2d(levels, view.factor)
        device = self.images.full.device
        return RecordedView(view.to(device), truth.to(device))

    def from_others(self, index: int, *, alone: bool = False) -> CameraView:
        """The view of one of its images by all of other instants, whose exposures give its own.

        `alone`: by its own camera's images only.
        """
        not_own = self.shared.of_others(self.name) if alone else set()
        view = self._view(index, self.shared.at_instant_of(index) | not_own)
        return replace(view, log_gain=self._log_gain(index, leave_out=True))

    def _view(self, index: int, leave_out: Collection[int], own: int | None = None) -> CameraView:
        """The view of one of its images; the scan of its instant is known to the others' depths alone.

        Shared images in `leave_out` are no sources; `own` as in `camera_view`.
        """
        recording = self.drive.world.recording
        pose = self.drive.left_out_pose(self.name, index)
        moving, lidar = self._returns(index)
        return camera_view(
            pose, recording.cameras[self.name].training.pinhole, lidar, self.images,
            self.shared.poses(recording), self.spec, instant=self.shared.instant, leave_out=leave_out,
            own=own, moving=moving,
        )  # fmt: skip

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
            time_s, frame = float(one.training_time_s[index]), int(one.training_frame[index])
            pose = self.drive.left_out_pose(self.name, index)
            moving = world.moving(time_s, self.shared.times_s(world.recording), leave_out=frame)
            static_m = world.static_points(time_s, leave_out=frame)
            found = moving, lidar_view(pose, one.training.pinhole, static_m, moving)
            self.returns[index] = found
        return found
