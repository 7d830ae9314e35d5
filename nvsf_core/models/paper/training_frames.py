"""The paper's training data, scaled to the unit cube, and the trainee: field and error maps."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.errors import DataError
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recording.images import CameraImages
from nvsf_core.sampling.error_map import CAMERA_CELL_PX, LIDAR_CELL_PX, ErrorMap


@dataclass(frozen=True, slots=True, kw_only=True)
class Panos:
    """Panos of k training scans, each from one pose a frame, as in the paper."""

    frame: np.ndarray
    """(k,) float64 frame coordinates: 0 for the scene's first frame, n - 1 for its last."""
    pose: np.ndarray
    """(k, 4, 4) float64, LiDAR to scene-local."""
    range_m: Tensor
    """(k, h, w) float32, metres; 0 = no return."""
    intensity: Tensor
    """(k, h, w) float32; 0 where nothing returned."""
    clouds: tuple[np.ndarray, ...]
    """Points (m, 3) float32 of each scan in scaled units, without ground, for the flow loss."""
    turn_up_rad: float
    """Angle by which the panos' rays are turned up, as those of sweeps are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Images:
    """The training images of one camera."""

    name: str
    images: CameraImages
    frame: np.ndarray
    """(k,) float64 frame coordinates of the images' frames, by which they belong to panos."""
    moment: np.ndarray
    """(k,) float64 frame coordinates of the images' own instants."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperFrames:
    """All training data of a scene."""

    bounds: Bounds
    count: int
    """n: number of frames of the scene, held-out ones included; frame coordinates are 0 to n - 1."""
    panos: Panos | None
    cameras: tuple[Images, ...]

    def __post_init__(self) -> None:
        """Check that there is something to learn from."""
        if not len(self.frames):
            raise DataError("expected at least one training scan or image, found none; look at `frames`")

    @property
    def frames(self) -> np.ndarray:
        """Frame coordinates (n,) with a scan or an image, ascending."""
        scans = np.zeros(0) if self.panos is None else self.panos.frame
        return np.unique(np.concatenate([scans, *(camera.frame for camera in self.cameras)]))


class PaperTrainee(nn.Module):
    """The field, and the error maps that decide which rays are sampled."""

    field: SceneField
    pano_errors: ErrorMap | None
    image_errors: nn.ModuleDict
    """By camera; empty if only the LiDAR is trained on."""

    def __init__(self, recipe: PaperRecipe, frames: PaperFrames, generator: torch.Generator) -> None:
        """Initialise the field's weights and empty error maps."""
        super().__init__()
        self.recipe = recipe
        self.field = SceneField(recipe, frames.count, generator)
        panos = frames.panos
        self.pano_errors = None
        if panos is not None:
            count, height, width = panos.range_m.shape
            self.pano_errors = ErrorMap(count, height, width, LIDAR_CELL_PX)
        used = frames.cameras if recipe.sampling.camera else ()
        self.image_errors = nn.ModuleDict()
        for camera in used:
            shown = torch.from_numpy(camera.images.valid)
            height, width = shown.shape
            self.image_errors[camera.name] = ErrorMap(len(camera.frame), height, width, CAMERA_CELL_PX, shown)

    @property
    def device(self) -> torch.device:
        """The device that the field is on."""
        return next(self.field.parameters()).device
