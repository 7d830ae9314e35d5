"""An image of the trained field."""

import numpy as np
import torch

from nvsf_core.fields.camera_field import CameraField
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import BackgroundSpec
from nvsf_core.rendering.camera import Propose, render_colour
from nvsf_core.simulation.scene_model import ImageRenderer

_CHUNK_PIXELS = 32768


def field_image_renderer(field: CameraField, propose: Propose, spec: BackgroundSpec) -> ImageRenderer:
    """Images by the trained field, which takes everything to stand still."""

    def render(camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float) -> np.ndarray:
        return render_image(field, propose, pinhole, pose, spec)

    return render


@torch.no_grad()
def render_image(
    field: CameraField, propose: Propose, pinhole: Pinhole, pose: np.ndarray, spec: BackgroundSpec
) -> np.ndarray:
    """The view (h, w, 3) uint8 of a camera at `pose` (4, 4), camera to scene-local."""
    direction = (pinhole.rays(pinhole.pixels()) @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    origin = np.broadcast_to(pose[:3, 3].astype(np.float32), direction.shape)
    colours = []
    for start in range(0, len(direction), _CHUNK_PIXELS):
        part = slice(start, start + _CHUNK_PIXELS)
        colours.append(render_colour(field, propose(origin[part], direction[part]), spec))
    image = (torch.cat(colours) * 255.0).round().to(torch.uint8)
    return image.reshape(pinhole.height, pinhole.width, 3).numpy()
