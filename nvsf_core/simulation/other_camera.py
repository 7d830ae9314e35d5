"""Images of a camera of other intrinsics, pinhole or fisheye, from renderings by a recorded camera's.

Both stand at the same place, so their pixels are the same rays: as many images of the recorded camera's
intrinsics as cover the other's field of view are rendered, turned about that place, and sampled. Detail is
that of the recorded camera.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.camera_fan import camera_rays, covering_rotations
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import pose_from_parts
from nvsf_core.rendering.rendered import RenderedImage


@dataclass(frozen=True, slots=True, eq=False)
class OtherCamera:
    """How a camera's pixels are sampled from images of another's intrinsics."""

    pinhole: Pinhole
    """Of the recorded camera."""
    rotations: tuple[np.ndarray, ...]
    """Each (3, 3): of an image in the camera's own axes."""
    pixel: np.ndarray
    """(H, W, 2) float64: where each pixel lies in its image, as (u, v)."""
    source: np.ndarray
    """(H, W) int64: which image; -1 = outside of the lens's image."""

    @staticmethod
    def of(model: Pinhole | MeiFisheye, pinhole: Pinhole) -> "OtherCamera":
        """Plan the images that cover a camera.

        Raises:
            DataError: See `covering_rotations`.
        """
        rays, seen = camera_rays(model)
        pixel = np.zeros((*rays.shape[:2], 2))
        source, best = np.full(rays.shape[:2], -1), np.full(rays.shape[:2], -np.inf)
        rotations = covering_rotations(rays[seen], pinhole)
        for number, rotation in enumerate(rotations):
            local = rays @ rotation
            found, inside = pinhole.project(local)
            # Nearer to an image's axis its pixels are less stretched.
            better = inside & seen & (local[..., 2] > best)
            pixel[better], source[better], best[better] = found[better], number, local[better][:, 2]
        return OtherCamera(pinhole, rotations, pixel, source)

    def render(self, pose: np.ndarray, one: Callable[[np.ndarray], RenderedImage]) -> RenderedImage:
        """The image at `pose` (4, 4), camera to scene; `one` renders the recorded intrinsics at a pose."""
        shape = self.source.shape
        rgb, range_m = np.zeros((*shape, 3), np.uint8), np.full(shape, np.inf, np.float32)
        support: np.ndarray | None = None
        for number, rotation in enumerate(self.rotations):
            chosen = self.source == number
            if not chosen.any():
                continue
            turned = pose @ pose_from_parts(rotation, np.zeros(3))
            image = one(turned)
            at = self.pixel[chosen]
            rgb[chosen] = _sampled(image.rgb, at)
            nearest = np.rint(at).astype(np.int64)
            range_m[chosen] = image.range_m[nearest[:, 1], nearest[:, 0]]
            if image.support is not None:
                support = np.zeros(shape, np.uint8) if support is None else support
                support[chosen] = image.support[nearest[:, 1], nearest[:, 0]]
        return RenderedImage(rgb, range_m, support)


def _sampled(rgb: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Colours (n, 3) uint8 of an image (H, W, 3) at pixels (n, 2), between pixels in proportion."""
    height, width = rgb.shape[:2]
    low = np.clip(np.floor(pixel).astype(np.int64), 0, [width - 2, height - 2])
    share = np.clip(pixel - low, 0.0, 1.0)
    found = np.zeros((len(pixel), 3))
    for right in (0, 1):
        for below in (0, 1):
            weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - below - share[:, 1])
            found += weight[:, None] * rgb[low[:, 1] + below, low[:, 0] + right]
    return np.asarray(np.clip(np.rint(found), 0, 255).astype(np.uint8))
