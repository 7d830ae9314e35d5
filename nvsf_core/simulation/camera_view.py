"""An image of the trained field."""

import numpy as np
import torch

from nvsf_core.evidence.surfels import Surfels
from nvsf_core.fields.camera_field import CameraField
from nvsf_core.fields.surface_batch import surface_batch
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import Recipe
from nvsf_core.rendering.camera import NEAR_M, render_colour

_CHUNK_PIXELS = 32768


@torch.no_grad()
def render_image(
    field: CameraField, surfels: Surfels, pinhole: Pinhole, pose: np.ndarray, recipe: Recipe
) -> np.ndarray:
    """The view (h, w, 3) uint8 of a camera at `pose` (4, 4), camera to scene-local."""
    direction = (pinhole.rays(pinhole.pixels()) @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    origin = np.broadcast_to(pose[:3, 3].astype(np.float32), direction.shape)
    colours = []
    for start in range(0, len(direction), _CHUNK_PIXELS):
        part = slice(start, start + _CHUNK_PIXELS)
        batch = surface_batch(
            surfels, origin[part], direction[part], most=recipe.evidence.camera_candidates, near_m=NEAR_M,
            far_m=recipe.background.far_m,
        )  # fmt: skip
        colours.append(render_colour(field, batch, recipe.background))
    image = (torch.cat(colours) * 255.0).round().to(torch.uint8)
    return image.reshape(pinhole.height, pinhole.width, 3).numpy()
