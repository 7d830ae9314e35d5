"""Everything that a step of the paper's training changes, so that a checkpoint holds it all."""

import torch
from torch import Tensor, nn

from nvsf_core.fields.scene_field import SceneField
from nvsf_core.models.paper.training.frames import Images, PaperFrames
from nvsf_core.recipe import PaperRecipe
from nvsf_core.sampling.error_map import CAMERA_CELL_PX, LIDAR_CELL_PX, ErrorMap


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
