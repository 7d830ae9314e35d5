"""Pixels of an image that show a moving object: also wheels, glass and its shadow, but not what is around it.

A pixel near an object's rim is static or moves with the object. Other images tell which: those that see the
static place at another time, or the object at another place, show the same colour there, or do not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from scipy.ndimage import binary_propagation
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.kernels.images.depth_refinement import WINDOW_REACH_PX, likeliest_surface
from nvsf_core.kernels.images.filling import nearest_known
from nvsf_core.kernels.images.source_lookup import least_differences
from nvsf_core.rendering.camera_view import Window
from nvsf_core.rendering.lidar_view import MovingPoints
from nvsf_core.rendering.sources import SeenPoints, Sources, kernel_inputs
from nvsf_core.rendering.view_depth_maps import camera_distance_m, image_motions
from nvsf_core.rendering.warping import plane_rays

_COMPARED = 6
"""Images that a pixel is looked up in: the nearest as what is static sees them, and as the object does."""
_REACH_M, _REACH_PX = 0.5, 60.0
"""Pixels are asked about up to this distance from the object, measured at its depth, and in the image."""
_IN_FRONT = np.float32(1.01)
"""What hides a static surface is nearer than it: its inverse depth is at least so many times as large."""
_NOWHERE = np.float32(2.0)
"""Difference of colours where no other image shows the point: more than any two, which are 0..1."""
_LARGEST, _EXPECTED = np.float32(0.06), np.float32(0.03)
"""The largest difference that counts, and the one mostly assumed where no other image shows the point."""
_OBJECT_COSTS = np.float32(0.01)
"""An object must look more alike by so much."""
_RIM_PX = 6.0
"""Returns lie on an object, but pixels that far from them count as its own until others are asked."""
_BEHIND = np.float32(1.05)
"""What is seen beside an object is behind it if its inverse depth is at most that of the object over this."""


@dataclass(frozen=True, slots=True)
class ComparedImages:
    """Images that are compared with one of them."""

    images: Tensor
    """(j, c, H, W) on the CPU, channels as of `Sources.images`; no depths are known yet."""
    poses: np.ndarray
    """(j, 4, 4) camera to scene-local frame."""
    pinhole: Pinhole
    """Intrinsics of all images."""
    own: int
    """Number of the image that is asked about."""
    others: Sequence[int]
    """Numbers of those that it is compared with."""


def outlined(
    inverse: np.ndarray, mover: np.ndarray, moving: Sequence[MovingPoints], compared: ComparedImages
) -> tuple[np.ndarray, np.ndarray]:
    """A recorded image's depths and moving objects: what moves with an object, and only that, is part of it.

    Of inverse depths (H, W) float32, positive, 1/m, and numbers (H, W) int16 of the moving objects that
    returns show, 0 = none; `moving` are those of its instant. Both are returned as given, but for what was
    found to be an object's.
    """
    inverse, mover = inverse.copy(), mover.copy()
    for each in moving:
        shown = mover == each.number
        if shown.any():
            around = _around(shown, inverse, compared.pinhole)
            _outline(inverse[around], mover[around], _OneObject.of(each, compared, around))
    return inverse, mover


def _around(shown: np.ndarray, inverse: np.ndarray, pinhole: Pinhole) -> Window:
    """The part of the image on which what becomes of an object depends: all that is asked, and around it."""
    reach_px = min(_REACH_PX, _REACH_M * pinhole.fx * float(inverse[shown].max()))
    margin = math.ceil(reach_px) + 1 + WINDOW_REACH_PX
    sides = []
    for axis, length in enumerate(shown.shape):
        place = np.flatnonzero(shown.any(axis=1 - axis))
        sides.append(slice(max(0, int(place[0]) - margin), min(length, int(place[-1]) + margin + 1)))
    return sides[0], sides[1]


@dataclass(frozen=True, slots=True)
class _OneObject:
    """A moving object, and the h x w pixels around it in the image that is asked about."""

    number: int
    motions: np.ndarray
    """(2, j, 4, 4) of what is static, and of the object, see `image_motions`."""
    rays: Tensor
    """(h, w, 3) float32 directions (x, y, 1) of the pixels."""
    colours: np.ndarray
    """(h, w, 3) float32 of the pixels, 0..1."""
    compared: ComparedImages
    """The image that they are of, and the others."""

    @classmethod
    def of(cls, moving: MovingPoints, compared: ComparedImages, around: Window) -> Self:
        """The object and the pixels `around` it."""
        poses, own = compared.poses, compared.images[compared.own, :3, *around]
        return cls(
            number=moving.number,
            motions=image_motions(poses[compared.own], poses, [moving.moved]),
            rays=plane_rays(compared.pinhole)[around],
            colours=np.ascontiguousarray(own.permute(1, 2, 0).numpy()),
            compared=compared,
        )


def _outline(inverse: np.ndarray, mover: np.ndarray, one: _OneObject) -> None:
    """Change depths (h, w), 1/m, and numbers of objects (h, w) of the pixels around an object, in place."""
    shown = mover == one.number
    is_it, depth = _beside(inverse, shown, one)
    is_it &= mover == 0
    # An object is of one piece: dark glass behind a dark wheel may look like it, and is not.
    is_it &= binary_propagation(shown, mask=shown | is_it)
    inverse[is_it], mover[is_it] = depth[is_it], one.number
    is_static, behind = _inside_rim(inverse, mover == one.number, one)
    inverse[is_static], mover[is_static] = behind[is_static], 0


def _beside(inverse: np.ndarray, shown: np.ndarray, one: _OneObject) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (h, w) bool around those `shown` that are an object's, and inverse depths (h, w), 1/m, for them.

    The depth is that of the nearest pixel shown; wheels and shadows touch the road, where it is the road's.
    """
    gap_px, nearest = nearest_known(shown)
    beside = inverse[nearest[0], nearest[1]]
    asked = gap_px <= np.minimum(_REACH_PX, _REACH_M * one.compared.pinhole.fx * beside)
    depth = np.where(shown, inverse, np.maximum(beside, inverse * _IN_FRONT))
    static = _difference(np.where(asked, inverse, np.float32(0.0)), one, moves=False)
    of_it = _difference(np.where(asked, depth, np.float32(0.0)), one, moves=True)
    other = np.where(asked, depth, inverse)
    return _is_rather(inverse, other, (static, of_it + _OBJECT_COSTS), one), depth


def _inside_rim(inverse: np.ndarray, shown: np.ndarray, one: _OneObject) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (h, w) bool of those `shown` that are static, and inverse depths (h, w), 1/m, for them.

    The depth is that of the nearest pixel outside. Only what others show as static there is taken away.
    """
    if shown.all():
        return np.zeros_like(shown), inverse
    gap_px, nearest = nearest_known(~shown)
    behind = inverse[nearest[0], nearest[1]]
    asked = shown & (gap_px <= _RIM_PX) & (behind * _BEHIND <= inverse)
    static = _difference(np.where(asked, behind, np.float32(0.0)), one, moves=False, unseen=_NOWHERE)
    of_it = _difference(np.where(asked, inverse, np.float32(0.0)), one, moves=True)
    is_static = _is_rather(inverse, np.where(asked, behind, inverse), (of_it, static), one)
    # What is around an object reaches into its pixels from outside.
    is_static &= binary_propagation(~shown, mask=~shown | is_static)
    return is_static, behind


def _is_rather(
    inverse: np.ndarray, other: np.ndarray, costs: tuple[np.ndarray, np.ndarray], one: _OneObject
) -> np.ndarray:
    """Pixels (h, w) bool that show the `other` surface rather than that of `inverse`, both (h, w), 1/m.

    `costs` (h, w) of each: how much other images differ there, see `_difference`.
    """
    found = likeliest_surface(one.colours, np.stack([inverse, other]), np.stack(costs))
    return (found == other) & (inverse != other)


def _difference(
    inverse: np.ndarray, one: _OneObject, *, moves: bool, unseen: np.float32 = _EXPECTED
) -> np.ndarray:
    """How much (h, w) float32 other images differ from the image at its pixels' inverse depths (h, w), 1/m.

    At most `_LARGEST`; `unseen` where none of them shows the point; 0 = not asked. Pixels move as the object
    does, or are static.
    """
    motions = one.motions if moves else one.motions[:1]
    others = np.array(one.compared.others, np.int64)
    distance_m = camera_distance_m(motions[-1, others])
    near = np.argsort(distance_m, kind="stable")[:_COMPARED]
    chosen = others[near[np.isfinite(distance_m[near])]].tolist()
    to_sources = torch.from_numpy(motions[:, chosen].astype(np.float32))
    sources = Sources(one.compared.images, chosen, to_sources[0], torch.ones(len(chosen)), to_sources[1:])
    label = torch.full(inverse.shape, len(motions) - 1, dtype=torch.uint8)
    # The kernel compares pixels whose depths differ; of a layer without depths it asks nothing.
    layers = torch.from_numpy(np.stack([np.zeros_like(inverse), inverse]))
    where = kernel_inputs(sources, SeenPoints(one.rays, layers, label), one.compared.pinhole)
    found = least_differences(where, one.colours, float(_NOWHERE))[1]
    return np.where(found < _NOWHERE, np.minimum(found, _LARGEST), unseen)
