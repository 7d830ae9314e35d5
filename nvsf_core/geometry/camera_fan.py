"""Images of one camera, turned about its place, that together cover another camera's field of view."""

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import rotation_of

_MOST_IMAGES = 40
_PLACES = 256
"""Pixels along a camera's longer side by which it is checked before anything is trained."""
_OVERLAP = 0.85
"""Step between turned images, as a share of their field of view."""
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in axes x forward, y left, z up."""


def covering_rotations(rays: np.ndarray, pinhole: Pinhole) -> tuple[np.ndarray, ...]:
    """Rotations, each (3, 3) of an image in the camera's own axes, that cover the rays (n, 3) of its pixels.

    `pinhole` is the camera whose images are turned.

    Raises:
        DataError: They would be too many, or leave something out: the turned camera's field of view is too
            small for this.
    """
    missing = rays
    rotations: list[np.ndarray] = []
    for rotation in _fan(pinhole):
        if len(missing) == 0:
            break
        _, inside = pinhole.project(missing @ rotation)
        if not inside.any():
            continue
        missing = missing[~inside]
        rotations.append(rotation)
        if len(rotations) > _MOST_IMAGES:
            raise DataError(
                f"expected a field of view that {_MOST_IMAGES} images of the recorded camera cover, "
                "found a larger one; ask for a smaller one, or for another `like`"
            )
    if len(missing):
        raise DataError(
            f"expected a field of view that turned images of the recorded camera cover, found "
            f"{len(missing) / len(rays):.2%} of its pixels outside of all of them; ask for a smaller one, or "
            "for another `like`"
        )
    return tuple(rotations)


def require_coverage(model: Pinhole | MeiFisheye, pinhole: Pinhole) -> None:
    """Refuse a camera that images of another cannot cover, by some of its pixels: in a fraction of a second.

    Raises:
        DataError: See `covering_rotations`.
    """
    rays, seen = camera_rays(model, step_px=max(1, max(model.width, model.height) // _PLACES))
    covering_rotations(rays[seen], pinhole)


def camera_rays(model: Pinhole | MeiFisheye, step_px: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (H, W, 3) of a camera's pixels in its axes, and whether (H, W) the lens sees them.

    Of every `step_px`-th pixel; the last column and row are always among them.
    """
    columns, rows = (
        np.unique([*range(0, side, step_px), side - 1]).astype(np.float64)
        for side in (model.width, model.height)
    )
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    if isinstance(model, Pinhole):
        return model.rays(pixels), np.ones(pixels.shape[:2], np.bool_)
    rays, solved = model.unproject(pixels)
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
