"""Correction of a camera's poses: LiDAR returns must look alike in neighbouring images.

A drive's poses have errors of some millimetres and tenths of a milliradian. On a near hedge that is a pixel
and more, which blurs the mean of several images. The place of a scan's return in the image taken with the
scan does not depend on the pose; its place in another image does, so grey values there measure the error.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import spsolve

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_se3, invert_pose
from nvsf_core.rendering.image_anchors import (
    Anchors,
    anchors_of,
    levels_at,
    near_images,
    projected,
    smoothed_grey,
)

_ROUNDS = 8
_PRIOR = np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.002])
"""Expected standard deviation of a pose's error: three in metres, three in radians."""
_NOISE = 0.1
"""Scale of the robust cost, in grey values 0..1: at larger differences a return is rather hidden."""
_SMOOTH_S = 0.75
"""Standard deviation in time over which corrections are averaged: pose errors change slowly."""


@dataclass(frozen=True, slots=True)
class PoseCorrection:
    """Corrections of a camera's poses at the instants of its aligned images."""

    time_s: np.ndarray
    """(n,) ascending, seconds: instants of the aligned images."""
    twist: np.ndarray
    """(n, 6) metres and radians in the camera's own frame: corrected = given exp(twist)."""

    def of_images(self, pose: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Corrected poses (m, 4, 4) of images with given poses (m, 4, 4) and times (m,).

        An aligned image has its own correction, any other one the average of those around it.
        """
        own = {instant_s: number for number, instant_s in enumerate(self.time_s.tolist())}
        corrected = [
            one @ exp_se3(self.twist[own[instant_s]]) if instant_s in own else self.at(one, instant_s)
            for one, instant_s in zip(pose, time_s.tolist(), strict=True)
        ]
        return np.stack(corrected)

    def at(self, pose: np.ndarray, time_s: float, *, leave_out: bool = False) -> np.ndarray:
        """The pose (4, 4) at any time, corrected by the corrections around it.

        Before the first and after the last image their corrections hold. `leave_out`: ignore that of the
        image of exactly that time.
        """
        used = self.time_s != time_s if leave_out and len(self.time_s) > 1 else np.ones(1, np.bool_)
        time_s = float(np.clip(time_s, self.time_s[0], self.time_s[-1]))
        weight = used * (np.exp(-0.5 * ((self.time_s - time_s) / _SMOOTH_S) ** 2) + 1e-12)
        weight /= weight.sum()
        offset_s = self.time_s - time_s
        # A line is fitted: a mean would lag at a drive's end, where all other images are on one side.
        middle_s = float(weight @ offset_s)
        spread = float(weight @ (offset_s - middle_s) ** 2)
        mean = weight @ self.twist
        slope = (weight * (offset_s - middle_s)) @ self.twist / (spread + 1e-4)
        return pose @ exp_se3(mean - slope * middle_s)


def align_images(
    rgb: Iterable[np.ndarray], pinhole: Pinhole, pose: np.ndarray, returns_m: Sequence[np.ndarray]
) -> np.ndarray:
    """Corrections (n, 6) of all poses, see `PoseCorrection.twist`; zeros if images do not agree better.

    Minimises, by Gauss-Newton with Geman-McClure weights, over all images j and their nearest ones k, the
    difference |I_k(project(T_k^-1 T_j p)) - I_j(project(p))| of the returns p of image j's scan, plus the
    squares of the corrections over those of `_PRIOR`. The median difference of a pair is taken off.

    Args:
        rgb: n images (h, w, 3) uint8.
        pinhole: Intrinsics of all images.
        pose: (n, 4, 4) camera to scene-local frame, as given.
        returns_m: n arrays (m, 3), scene-local, metres: static returns of the scan of each image.
    """
    twist = np.zeros((len(pose), 6))
    if len(pose) < 2:
        return twist
    seen = [_with_slopes(image) for image in rgb]
    anchors = [
        anchors_of(image, pinhole, one, points)
        for image, one, points in zip(seen, pose, returns_m, strict=True)
    ]
    pairs = [(j, k) for j, found in enumerate(anchors) if len(found.grey) for k in near_images(pose, j)]
    for _ in range(_ROUNDS):
        twist = _improved(twist, pose, pairs, anchors, seen, pinhole)
    before, after = (
        sum(_cost(_residual(anchors[j], motion, seen[k], pinhole)[0]) for j, k, motion in _motions(x, pairs))
        for x in (pose, pose @ exp_se3(twist))
    )
    return twist if after < before else np.zeros_like(twist)


def _improved(
    twist: np.ndarray,
    pose: np.ndarray,
    pairs: Sequence[tuple[int, int]],
    anchors: Sequence[Anchors],
    seen: Sequence[np.ndarray],
    pinhole: Pinhole,
) -> np.ndarray:
    """The twists (n, 6) after one step of Gauss-Newton."""
    right = -twist * _PRIOR**-2.0
    # Each image is compared with few others: only their blocks of the normal matrix are not zero.
    places = [(image, image) for image in range(len(pose))]
    blocks = [np.diag(_PRIOR**-2.0)] * len(pose)
    for j, k, motion in _motions(pose @ exp_se3(twist), pairs):
        residual, by_j, by_k = _residual(anchors[j], motion, seen[k], pinhole)
        weight = 1.0 / (1.0 + (residual / _NOISE) ** 2) ** 2 / _NOISE**2
        weighted_j, weighted_k = by_j * weight[:, None], by_k * weight[:, None]
        mixed = weighted_j.T @ by_k
        places += [(j, j), (k, k), (j, k), (k, j)]
        blocks += [weighted_j.T @ by_j, weighted_k.T @ by_k, mixed, mixed.T]
        right[j] -= weighted_j.T @ residual
        right[k] -= weighted_k.T @ residual
    step = spsolve(_of_blocks(places, blocks), right.reshape(-1))
    return twist + step.reshape(twist.shape)


def _of_blocks(places: Sequence[tuple[int, int]], blocks: Sequence[np.ndarray]) -> csc_array:
    """Sparse matrix of blocks (6, 6), each at (row, column) counted in blocks; blocks at one place add up."""
    within = np.arange(6)
    row, column = 6 * np.array(places).T[:, :, None, None]
    value = np.stack(blocks)
    at = [np.broadcast_to(one, value.shape).ravel() for one in (row + within[:, None], column + within)]
    return coo_array((value.ravel(), tuple(at))).tocsc()


def _motions(pose: np.ndarray, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int, np.ndarray]]:
    """Each pair with the motion (4, 4) from the first camera's frame to the second's."""
    inverse = invert_pose(pose)
    return [(j, k, inverse[k] @ pose[j]) for j, k in pairs]


def _residual(
    anchors: Anchors, motion: np.ndarray, seen: np.ndarray, pinhole: Pinhole
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey values of anchors in another image, minus those in their own, for anchors that it shows.

    Returns:
        (m,), and its derivatives (m, 6) by the twists of the anchors' own pose and of the other one.
    """
    point = anchors.point_m @ motion[:3, :3].T + motion[:3, 3]
    pixels, inside = projected(point, pinhole)
    point, own = point[inside], anchors.point_m[inside]
    found = levels_at(seen, pixels[inside])
    residual = found[:, 0] - anchors.grey[inside]
    if len(residual):
        residual = residual - np.median(residual)
    # d I / d point, by the chain rule through u = fx x / z + cx, v = fy y / z + cy.
    depth_m = point[:, 2]
    across, down = found[:, 1] * pinhole.fx / depth_m, found[:, 2] * pinhole.fy / depth_m
    slope = np.stack([across, down, -(across * point[:, 0] + down * point[:, 1]) / depth_m], axis=1)
    turned = slope @ motion[:3, :3]
    by_own = np.concatenate([turned, np.cross(own, turned)], axis=1)
    by_other = -np.concatenate([slope, np.cross(point, slope)], axis=1)
    return residual, by_own, by_other


def _cost(residual: np.ndarray) -> float:
    """Geman-McClure cost, minus that of as many returns with infinite differences."""
    return -float((1.0 / (1.0 + (residual / _NOISE) ** 2)).sum())


def _with_slopes(image: np.ndarray) -> np.ndarray:
    """(3, h, w) float32: smoothed grey values 0..1, their slopes along a row and along a column."""
    grey = smoothed_grey(image)
    down, across = np.gradient(grey)
    return np.stack([grey, across, down]).astype(np.float32)
