"""Exposure of a camera's images: how much brighter each is than the others, and levels at another exposure.

A camera with automatic exposure shows the same wall brighter in one image than in the next one: by up to a
fifth from frame to frame on KITTI-360. Levels are those of the file, 0..1, which are no linear measure of
light: there, too, another exposure multiplies them, up to where the sensor saturates.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.rendering.image_anchors import (
    Anchors,
    anchors_of,
    levels_at,
    near_images,
    projected,
    smoothed_grey,
)

_SHOULDER = 8.0
"""The larger, the nearer to the brightest level gains begin to fade."""
_DARK, _GLARE = 0.04, 0.82
"""Smoothed grey values, mean of two images, between which levels tell the gain."""
_FEWEST = 100
"""Returns that two images must both show."""
_PAIR_NOISE = 0.01
"""Standard deviation of the logarithm of the gain that one pair of images tells."""
_SPREAD = 0.3
"""Of the logarithms of a drive's gains: pulls them to 0, lest what a lens darkens adds up along a drive."""


def at_exposure(levels: Tensor, log_gain: float) -> Tensor:
    """Levels as they would be with another exposure; 0 and 1 stay, others stay between; cut off outside.

    With t the logarithm of the gain and p the shoulder, x becomes e^t x / (1 + (e^(p t) - 1) x^p)^(1/p): in
    the dark x e^t, and 1 at 1. Two gains after each other are one of the sum of their logarithms, so that
    -t leads back.
    """
    if log_gain == 0.0:
        return levels
    x = levels.clamp(0.0, 1.0)
    saturation = 1.0 + math.expm1(_SHOULDER * log_gain) * x**_SHOULDER
    return math.exp(log_gain) * x * saturation ** (-1.0 / _SHOULDER)


def recorded_at_exposure(image: np.ndarray, log_gain: float) -> Tensor:
    """Levels (3, h, w) float32, 0..1, of an image (h, w, 3) uint8 as they would be with another exposure."""
    table: np.ndarray = at_exposure(torch.arange(256) / 255.0, log_gain).numpy()
    return torch.from_numpy(table[image]).permute(2, 0, 1)


def log_gains(
    rgb: np.ndarray, pinhole: Pinhole, pose: np.ndarray, returns_m: Sequence[np.ndarray]
) -> np.ndarray:
    """Natural logarithms (n,) of the gains of a camera's images, about 0 on the mean; 0 where nothing tells.

    The ratio of two neighbouring images is the median over returns that both show. All ratios together give
    the gains, by least squares.

    Args:
        rgb: (n, h, w, 3) uint8.
        pinhole: Intrinsics of all images.
        pose: (n, 4, 4) camera to scene-local frame.
        returns_m: n arrays (m, 3), scene-local, metres: static returns of the scan of each image.
    """
    count = len(pose)
    if count < 2:
        return np.zeros(count)
    seen = [smoothed_grey(image)[None] for image in rgb]
    inverse, pairs, ratios = invert_pose(pose), list[tuple[int, int]](), list[float]()
    for j, points_m in enumerate(returns_m):
        anchors = anchors_of(seen[j], pinhole, pose[j], points_m)
        for k in near_images(pose, j):
            ratio = _log_ratio(anchors, inverse[k] @ pose[j], seen[k], pinhole)
            if ratio is not None:
                pairs.append((j, k))
                ratios.append(ratio)
    if not pairs:
        return np.zeros(count)
    row = np.arange(len(pairs))
    first, second = np.array(pairs).T
    sign = np.concatenate([np.full(len(pairs), -1.0), np.ones(len(pairs))])
    places = np.concatenate([row, row]), np.concatenate([first, second])
    difference = coo_array((sign, places), (len(pairs), count)).tocsc()
    normal = difference.T @ difference / _PAIR_NOISE**2 + eye_array(count) / _SPREAD**2
    return spsolve(normal.tocsc(), difference.T @ np.array(ratios) / _PAIR_NOISE**2)


def _log_ratio(anchors: Anchors, motion: np.ndarray, seen: np.ndarray, pinhole: Pinhole) -> float | None:
    """Median of log(level there / own level) over the anchors that another image shows; None if too few."""
    pixels, inside = projected(anchors.point_m @ motion[:3, :3].T + motion[:3, 3], pinhole)
    own, there = anchors.grey[inside], levels_at(seen, pixels[inside])[:, 0]
    middle = 0.5 * (own + there)
    tells = (middle > _DARK) & (middle < _GLARE) & (np.minimum(own, there) > 0.25 * _DARK)
    if np.count_nonzero(tells) < _FEWEST:
        return None
    return float(np.median(np.log(there[tells] / own[tells])))
