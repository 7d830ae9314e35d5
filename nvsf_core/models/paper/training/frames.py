"""What the paper's training sees, scaled to the unit cube, and all that one of its steps changes."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from nvsf_core.errors import DataError
from nvsf_core.fields.scene_field import SceneField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recipe import PaperRecipe
from nvsf_core.recording.images import CameraImages
from nvsf_core.sampling.error_map import CAMERA_CELL_PX, LIDAR_CELL_PX, ErrorMap


@dataclass(frozen=True, slots=True, kw_only=True)
class Panos:
    """Range images of k training scans, each seen from its frame's one pose, as the paper does."""

    frame: np.ndarray
    """(k,) float64 frame coordinates: 0 for the scene's first frame, n - 1 for its last."""
    pose: np.ndarray
    """(k, 4, 4) float64 LiDAR to scene-local."""
    range_m: Tensor
    """(k, h, w) float32; 0 where nothing returned."""
    intensity: Tensor
    """(k, h, w) float32; 0 where nothing returned."""
    clouds: tuple[np.ndarray, ...]
    """Scaled points (m, 3) float32 of each scan without ground: what the flow is compared on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Images:
    """The training images of one camera."""

    name: str
    images: CameraImages
    frame: np.ndarray
    """(k,) float64 frame coordinates."""
    range_m: np.ndarray | None = None
    """(k, h, w) float32 ray lengths to the frame's own returns, 0 = none; None where no loss asks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperFrames:
    """All training data of a scene."""

    bounds: Bounds
    count: int
    """n: frames of the scene, held-out ones included; time runs from 0 to n - 1 in frame coordinates."""
    panos: Panos | None
    cameras: tuple[Images, ...]

    def __post_init__(self) -> None:
        """Refuse a scene without anything to learn from."""
        if not len(self.frames):
            raise DataError("expected at least one training scan or image, found none; look at `frames`")

    @property
    def frames(self) -> np.ndarray:
        """Frame coordinates that have a scan or an image, ascending: one is drawn a step."""
        scans = np.zeros(0) if self.panos is None else self.panos.frame
        return np.unique(np.concatenate([scans, *(camera.frame for camera in self.cameras)]))


class PaperTrainee(nn.Module):
    """The field, and the error maps that decide where it is trained next."""

    field: SceneField
    pano_errors: ErrorMap | None
    image_errors: nn.ModuleDict
    """By camera; empty where only the LiDAR is trained on."""

    def __init__(self, recipe: PaperRecipe, frames: PaperFrames, generator: torch.Generator) -> None:
        """Draw the field's weights; the error maps know nothing yet."""
        super().__init__()
        self.recipe = recipe
        self.field = SceneField(recipe, frames.count, generator)
        panos = frames.panos
        self.pano_errors = None
        if panos is not None:
            count, height, width = panos.range_m.shape
            self.pano_errors = ErrorMap(count, height, width, LIDAR_CELL_PX)
        used = frames.cameras if recipe.sampling.camera else ()
        self.image_errors = nn.ModuleDict({camera.name: _image_errors(camera) for camera in used})

    @property
    def device(self) -> torch.device:
        """Where the field lives."""
        return next(self.field.parameters()).device

    def lidar_attributes(self, direction: Tensor, geometry: Tensor) -> Tensor:
        """Intensity and hit probability (m, 2)."""
        return torch.stack(self.field.lidar(direction, geometry), dim=1)


def _image_errors(camera: Images) -> ErrorMap:
    pinhole = camera.images.pinhole
    shown = torch.zeros(pinhole.height * pinhole.width, dtype=torch.bool)
    shown[torch.from_numpy(camera.images.pixel)] = True
    mask = shown.reshape(pinhole.height, pinhole.width)
    return ErrorMap(len(camera.frame), pinhole.height, pinhole.width, CAMERA_CELL_PX, mask)
