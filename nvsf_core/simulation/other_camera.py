"""Images of a camera of other intrinsics, pinhole or fisheye, from renderings by a recorded camera's.

Both stand at the same place, so their pixels are the same rays: as many images of the recorded camera's
intrinsics as cover the other's field of view are rendered, turned about that place, and sampled. Detail is
that of the recorded camera.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import pose_from_parts, rotation_of
from nvsf_core.rendering.rendered import RenderedImage

_MOST_IMAGES = 40
_OVERLAP = 0.85
"""Step between turned images, as a share of their field of view."""
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in axes x forward, y left, z up."""


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
            DataError: They would be too many: the recorded camera's field of view is too small for this.
        """
        rays, seen = camera_rays(model)
        pixel = np.zeros((*rays.shape[:2], 2))
        source, best = np.full(rays.shape[:2], -1), np.full(rays.shape[:2], -np.inf)
        rotations: list[np.ndarray] = []
        missing = seen.copy()
        for rotation in _fan(pinhole):
            if not missing.any():
                break
            local = rays @ rotation
            found, inside = pinhole.project(local)
            if not (inside & missing).any():
                continue
            # Nearer to an image's axis its pixels are less stretched.
            better = inside & seen & (local[..., 2] > best)
            pixel[better], source[better], best[better] = found[better], len(rotations), local[better][:, 2]
            missing &= ~inside
            rotations.append(rotation)
            if len(rotations) > _MOST_IMAGES:
                raise DataError(
                    f"expected a field of view that {_MOST_IMAGES} images of the recorded camera cover, "
                    "found a larger one; ask for a smaller one, or for another `like`"
                )
        return OtherCamera(pinhole, tuple(rotations), pixel, source)

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


def camera_rays(model: Pinhole | MeiFisheye) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (H, W, 3) of the pixels in the camera's axes, and whether (H, W) the lens sees them."""
    if isinstance(model, Pinhole):
        return model.rays(model.pixels()), np.ones((model.height, model.width), np.bool_)
    v, u = np.mgrid[0 : model.height, 0 : model.width]
    rays, solved = model.unproject(np.stack([u, v], axis=-1).astype(np.float64))
    seen = solved & np.isfinite(rays).all(axis=-1)
    return np.where(seen[..., None], rays, (0.0, 0.0, 1.0)), seen


def _fan(pinhole: Pinhole) -> list[np.ndarray]:
    """Rotations (3, 3) of images all around, the camera's own first, then those that are turned less."""
    across = np.degrees(
        np.arctan(pinhole.cx / pinhole.fx) + np.arctan((pinhole.width - 1 - pinhole.cx) / pinhole.fx)
    )
    down = np.degrees(
        np.arctan(pinhole.cy / pinhole.fy) + np.arctan((pinhole.height - 1 - pinhole.cy) / pinhole.fy)
    )
    yaws = np.arange(0.0, 180.0 + across, _OVERLAP * across)
    pitches = np.arange(0.0, 90.0 + down, _OVERLAP * down)
    turns = sorted(
        {(sign_y * yaw, sign_p * pitch) for yaw in yaws for pitch in pitches
         for sign_y in (-1.0, 1.0) for sign_p in (-1.0, 1.0)},
        key=lambda turn: (np.hypot(*turn), turn),
    )  # fmt: skip
    return [_AXES.T @ rotation_of(yaw, pitch, 0.0) @ _AXES for yaw, pitch in turns]


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
