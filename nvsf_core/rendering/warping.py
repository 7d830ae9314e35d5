"""Warping between camera images by depth: where a source shows a view's pixel, and its values there."""

import functools
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.numerics import require_finite

_CPU = torch.device("cpu")
_NEAREST_Z = 1e-3
"""Smallest z of a point scaled by its inverse depth; with less it counts as behind the source."""
_RIM_PX = 0.01
"""An image shows points that lie outside its outermost pixel centres by no more than rounding may do."""


def source_pixels(
    motion: Tensor, rays: Tensor, inverse: Tensor, pinhole: Pinhole
) -> tuple[Tensor, Tensor, Tensor]:
    """Places in a source image of a view's pixels, of directions (x, y, 1) (..., 3).

    A point at z-depth 1/q, of inverse depth q (...), 1/m, along the ray (x, y, 1) lies, scaled by q, at R (x,
    y, 1) + q t of the source, `motion` (4, 4) away: R and t. Returns grid_sample's coordinates (..., 2),
    whether the source shows the pixel (...) bool, and the inverse depth of its point in the source (...),
    1/m.
    """
    width, height = pinhole.width, pinhole.height
    # grid_sample's coordinates are linear in pixels: projection and conversion are one matrix.
    to_grid = torch.tensor(
        [
            [2.0 * pinhole.fx / width, 0.0, (2.0 * pinhole.cx + 1.0) / width - 1.0],
            [0.0, 2.0 * pinhole.fy / height, (2.0 * pinhole.cy + 1.0) / height - 1.0],
            [0.0, 0.0, 1.0],
        ],
        device=motion.device,
    )
    turned = rays @ (to_grid @ motion[:3, :3]).T
    shift = to_grid @ motion[:3, 3]
    x, y, z = (turned[..., axis] + inverse * shift[axis] for axis in range(3))
    scale = z.clamp_min(_NEAREST_Z).reciprocal()
    x, y = x * scale, y * scale
    most_x, most_y = (1.0 - (1.0 - 2.0 * _RIM_PX) / side for side in (width, height))
    seen = (z > _NEAREST_Z) & (x.abs() <= most_x) & (y.abs() <= most_y)
    return torch.stack([x, y], dim=-1), seen, inverse * scale


def sample(image: Tensor, grid: Tensor, mode: Literal["bilinear", "nearest"] = "bilinear") -> Tensor:
    """Values (c, H, W) of an image (c, h, w) at the places of `grid` (H, W, 2).

    Only this function calls grid_sample, which shows some pixel for a coordinate that is NaN.

    Raises:
        DivergedError: A coordinate of `grid` is not finite.
    """
    require_finite("coordinates of warped pixels", grid)
    return functional.grid_sample(
        image[None], grid[None], mode=mode, padding_mode="border", align_corners=False
    )[0]


@functools.lru_cache(maxsize=16)
def plane_rays(pinhole: Pinhole, device: torch.device = _CPU) -> Tensor:
    """(H, W, 3) float32 directions (x, y, 1) of a camera's pixels: times depth along z they give points."""
    directions = pinhole.rays(pinhole.pixels())
    return torch.from_numpy((directions / directions[..., 2:]).astype(np.float32)).to(device)


def ray_length(inverse: Tensor, pinhole: Pinhole) -> Tensor:
    """Range (H, W) in metres from inverse depth q (H, W) along z: |(x, y, 1)| / q; infinite where q <= 0."""
    return torch.linalg.vector_norm(plane_rays(pinhole, inverse.device), dim=-1) / inverse.clamp_min(0.0)


def relative_motion(target_pose: np.ndarray, source_pose: np.ndarray) -> Tensor:
    """(4, 4) float32 from the view's camera frame to a source's; poses (4, 4) are camera to scene-local."""
    return torch.from_numpy((invert_pose(source_pose) @ target_pose).astype(np.float32))


def shrunk(pinhole: Pinhole, factor: int) -> Pinhole:
    """Intrinsics of an image whose pixels are means of factor x factor pixels."""
    return Pinhole(
        fx=pinhole.fx / factor,
        fy=pinhole.fy / factor,
        cx=(pinhole.cx + 0.5) / factor - 0.5,
        cy=(pinhole.cy + 0.5) / factor - 0.5,
        width=pinhole.width // factor,
        height=pinhole.height // factor,
    )


def to_float(images: np.ndarray) -> Tensor:
    """Images (k, H, W, 3) uint8 as (k, 3, H, W) float32 in 0..1."""
    return torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 255.0
