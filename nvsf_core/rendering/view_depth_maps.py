"""Depth of a view from the depth maps of recorded images, and the images that see most of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.kernels.depth_splat import agreed_depths, splat_depth_map
from nvsf_core.rendering.reproject_camera import FAR_M
from nvsf_core.rendering.sources import hides
from nvsf_core.rendering.warping import plane_rays, relative_motion, sample, source_pixels

_MOST_MAPS = 12
"""Most images whose depth maps are carried into a view."""
_SPREAD = 1.2
"""Ranks of these images by distance grow by this factor: all of the nearest, fewer and fewer farther ones."""
_LEAST_SHARE = 0.3
"""Share of the maps, by weight, that make a surface."""
_DISTANCE_FLOOR_M = 0.5
_NEAREST_BASELINE_M = 0.75
"""Distance of the nearest image that a depth map is found by; each further one's is twice as large."""
_THINNED = 8
"""Sources are chosen by one pixel in so many rows and columns."""
_SECOND = 0.5
"""Worth of a pixel's second best source, beside its best one's."""


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Depth maps of the j images of a camera."""

    inverse: Tensor
    """(j, H, W) float32 inverse depths along z, 1/m; 0 = unknown."""
    mover: Tensor
    """(j, H, W) int16: number of the moving object that a pixel shows, 0 = static."""

    @property
    def static(self) -> Tensor:
        """(j, H, W) inverse depths of static surfaces alone, 1/m; else 0."""
        return torch.where(self.mover == 0, self.inverse, 0.0)


@dataclass(frozen=True, slots=True)
class ViewDepth:
    """What the recorded images' depth maps show in a view."""

    inverse: Tensor
    """(2, H, W) float32, 1/m, positive: the front surface and the best supported other one. Where no image
    shows the front, that of the nearest pixel with a static one; where there is no other, the front again."""
    support: Tensor
    """(2, H, W) float32, 0..1: weight of the maps that agree on each; 0 where no image shows it."""
    label: Tensor
    """(H, W) uint8: the moving object that the front shows, as an index of the motions that were given."""

    def to(self, device: torch.device) -> "ViewDepth":
        """The same depth on `device`."""
        return ViewDepth(self.inverse.to(device), self.support.to(device), self.label.to(device))

    def completed(self, label: Tensor, inverse: Tensor) -> "ViewDepth":
        """The same depth; where no image shows a surface but a LiDAR return a moving object, the return's.

        Args:
            label: (H, W) uint8, of the moving object, 0 = none.
            inverse: (H, W) of the return, 1/m.
        """
        where = (self.support[0] == 0.0) & (label > 0)
        return ViewDepth(
            torch.where(where, inverse, self.inverse), self.support, torch.where(where, label, self.label)
        )


def spread_ranks(count: int, most: int = _MOST_MAPS) -> list[int]:
    """At most `most` ascending ranks below `count`, dense at first and then sparser."""
    ranks: list[int] = []
    rank = 0.0
    while len(ranks) < most and round(rank) < count:
        ranks.append(round(rank))
        rank = max(rank + 1.0, rank * _SPREAD)
    return ranks


def depth_in_view(
    pose: np.ndarray,
    pinhole: Pinhole,
    inverse: Sequence[np.ndarray],
    label: Sequence[np.ndarray],
    poses: np.ndarray,
    moved: np.ndarray,
) -> ViewDepth:
    """The surfaces that the depth maps of images around a view agree on.

    Args:
        pose: (4, 4) camera to scene-local frame, of the view.
        pinhole: Intrinsics of the view and of all images.
        inverse: (H, W) float32 inverse depths of each of k images, 1/m; 0 = unknown.
        label: (H, W) uint8: what each of their pixels shows, an index of `moved`.
        poses: (k, 4, 4) camera to scene-local frame of each image.
        moved: (o, k, 4, 4) motion in the scene from the view's instant to each image's: the identity for what
            is static, then of each moving object; zeros where it is unknown.
    """
    intrinsics = (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)
    carried = [
        splat_depth_map(inverse[k], label[k], _to_view(pose, poses[k], moved[:, k]), intrinsics)
        for k in range(len(poses))
    ]
    weight = 1.0 / (np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) + _DISTANCE_FLOOR_M)
    depths, support, labels = agreed_depths(
        np.stack([one for one, _ in carried]), np.stack([one for _, one in carried]),
        weight.astype(np.float32), _LEAST_SHARE,
    )  # fmt: skip
    known = support[0] > 0.0
    # What a moving object uncovers is static, however near the object is in the image.
    static = known & (labels[0] == 0)
    if not static.any():
        depths[0] = np.where(known, depths[0], 1.0 / FAR_M)
    elif not known.all():
        where = distance_transform_edt(~static, return_distances=False, return_indices=True)
        depths[0] = np.where(known, depths[0], depths[0][where[0], where[1]])
    # A pixel is looked up as one thing: another one behind a moving object is left out.
    is_other = (support[1] > 0.0) & (labels[0] == labels[1])
    depths[1], support[1] = np.where(is_other, depths[1], depths[0]), np.where(is_other, support[1], 0.0)
    return ViewDepth(torch.from_numpy(depths), torch.from_numpy(support), torch.from_numpy(labels[0]))


def _to_view(pose: np.ndarray, source: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """(o, 4, 4) from an image's camera frame to the view's, by motions (o, 4, 4) between their instants."""
    motions = np.zeros_like(moved)
    known = moved[:, 3, 3] > 0.0
    motions[known] = invert_pose(pose) @ np.linalg.inv(moved[known]) @ source
    return motions


def baseline_sources(poses: np.ndarray, own: int, known: Sequence[int], most: int) -> list[int]:
    """Images at several distances from an image: near ones look alike, far ones tell depths apart.

    Args:
        poses: (j, 4, 4) camera to scene-local frame of all images.
        own: Number of the image.
        known: Numbers of the images to choose from.
        most: How many are chosen.
    """
    left = [number for number in known if number != own]
    chosen: list[int] = []
    for step in range(min(most, len(left))):
        away_m = np.linalg.norm(poses[left][:, :3, 3] - poses[own][:3, 3], axis=1)
        chosen.append(left.pop(int(np.argmin(np.abs(away_m - _NEAREST_BASELINE_M * 2.0**step)))))
    return chosen


def covering_sources(
    pose: np.ndarray,
    pinhole: Pinhole,
    inverse: Tensor,
    fronts: Sequence[Tensor],
    poses: np.ndarray,
    most: int,
) -> list[int]:
    """Images that together see most of a view, near ones preferred; the nearest is always one of them.

    Args:
        pose: (4, 4) camera to scene-local frame, of the view.
        pinhole: Intrinsics of the view and of all images.
        inverse: (H, W) inverse depth of the view, 1/m, positive.
        fronts: (H, W) inverse depths that hide what is behind them in each of k images, the nearest first.
        poses: (k, 4, 4) camera to scene-local frame of these images.
        most: How many are chosen.

    Returns:
        Places of the chosen among the k, ascending.
    """
    half = _THINNED // 2
    rays = plane_rays(pinhole)[half::_THINNED, half::_THINNED]
    wanted = inverse[half::_THINNED, half::_THINNED]
    worth = torch.stack(
        [
            _seen(relative_motion(pose, at), rays, wanted, front, pinhole).float()
            / (float(np.linalg.norm(at[:3, 3] - pose[:3, 3])) + _DISTANCE_FLOOR_M)
            for at, front in zip(poses, fronts, strict=True)
        ]
    )
    chosen = [0]
    while len(chosen) < min(most, len(poses)):
        best, second = _two_best(worth[chosen])
        # What each further image would add to the sum of the best and half of the second best of each pixel.
        gain = torch.where(
            worth > best, worth - best + _SECOND * (best - second), _SECOND * (worth - second).clamp_min(0.0)
        ).sum(dim=(1, 2))
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
    return sorted(chosen)


def _seen(motion: Tensor, rays: Tensor, inverse: Tensor, own: Tensor, pinhole: Pinhole) -> Tensor:
    """(h, w) bool: the view's points that an image with the depth map `own` shows."""
    grid, inside, there = source_pixels(motion, rays, inverse, pinhole)
    return inside & ~hides(sample(own[None], grid, "nearest")[0], there)


def _two_best(worth: Tensor) -> tuple[Tensor, Tensor]:
    best = worth.topk(min(2, len(worth)), dim=0).values
    return best[0], best[1] if len(best) > 1 else torch.zeros_like(best[0])
