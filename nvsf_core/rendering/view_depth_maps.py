"""Depth of a view from the depth maps of recorded images, and the images that see most of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.kernels.images.depth_smoothing import smoothed
from nvsf_core.kernels.images.depth_splat import agreed_depths, splat_depth_map
from nvsf_core.kernels.images.filling import nearest_known
from nvsf_core.rendering.reproject_camera import FAR_M, OTHER_WAY
from nvsf_core.rendering.sources import SeenPoints, hides
from nvsf_core.rendering.warping import plane_rays, sample, shrunk, source_pixels

_MOST_MAPS = 12
"""Most images whose depth maps are carried into a view."""
_SPREAD = 1.2
"""Ranks of these images by distance grow by this factor: all of the nearest, fewer and fewer farther ones."""
_BESIDE = 4
"""Instants, the nearest, of which the images of all cameras are taken; of others the nearest image only."""
_SHRUNK, _LEAST_NEW, _MOST_BEYOND = 4, 0.001, 6
"""At so small a size, one pixel of so many in a row, a further image must show this share of a view anew; so
many are added at most."""
_LEAST_SHARE = 0.5
"""Share of the maps that know a pixel, by weight, that must agree on its front surface."""
_SPECKLE = 0.5
"""Share of its support that the front of a single pixel keeps, as the other surface there."""
_DISTANCE_FLOOR_M = 0.5
_NEAREST_BASELINE_M = 0.75
"""Distance of the nearest image that a depth map is found by; each further one's is twice as large."""
_THINNED = 8
"""Sources are chosen by one pixel in so many rows and columns."""
_SECOND = 0.5
"""Worth of a pixel's second best source, beside its best one's."""
_FIRST = 0.5
"""Worth, 1/m, that a pixel's only source has beside its nearness: what one image alone shows is no hole."""
_MOST_MOVERS, _MAPS_OF_MOVER = 3, 3
"""So many moving objects, the largest in a view, have so many images of their own."""


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Depth maps of the j images of a camera."""

    inverse: Tensor
    """(j, H, W) float32 inverse depths along z, 1/m; 0 = unknown, negative = no other map confirms it."""
    mover: Tensor
    """(j, H, W) int16: number of the moving object that a pixel shows, 0 = static."""


@dataclass(frozen=True, slots=True)
class NearMaps:
    """Depth maps of k images near to a view, and how the images move against it."""

    motions: np.ndarray
    """(m, k, 4, 4) float64, see `image_motions`; the last are zeros."""
    inverse: list[np.ndarray]
    """(H, W) float32 inverse depths of each image, 1/m; 0 = unknown, negative = unconfirmed."""
    label: list[np.ndarray]
    """(H, W) uint8: what each of its pixels shows, an index of `motions`; the last if that is not in the
    view."""
    fronts: list[Tensor]
    """(H, W) inverse depths of each image, 1/m, that hide static surfaces behind them."""

    @property
    def weight(self) -> np.ndarray:
        """(m, k) float32, inversely proportional to the images' distances; 0 = unknown."""
        return (1.0 / (camera_distance_m(self.motions) + _DISTANCE_FLOOR_M)).astype(np.float32)


@dataclass(frozen=True, slots=True)
class ViewDepth:
    """What the recorded images' depth maps show in a view."""

    inverse: Tensor
    """(2, H, W) float32, 1/m, positive: the front surface, smoothed, and the best supported other one. Where
    no image shows the front, that of the nearest pixel with a static one; where there is no other, the front
    again. A single pixel's front is the median around it, its other surface what the maps have there."""
    support: Tensor
    """(2, H, W) float32, 0..1: weight of the maps that agree on each, before it is smoothed; 0 where no image
    shows it."""
    label: Tensor
    """(H, W) uint8: the moving object that the front shows, as an index of the motions that were given."""
    glimpsed: Tensor
    """(H, W) bool: some image shows something about here, at a depth that no other confirms."""

    def completed(self, label: Tensor, inverse: Tensor) -> "ViewDepth":
        """The same depth; where no image shows a surface but a LiDAR return a moving object, the return's.

        `label` (H, W) is the moving object of the return, 0 = none; `inverse` (H, W) the return's, 1/m.
        """
        where = (self.support[0] == 0.0) & (label > 0)
        return replace(
            self,
            inverse=torch.where(where, inverse, self.inverse),
            label=torch.where(where, label, self.label),
        )


def spread_ranks(count: int) -> list[int]:
    """At most `_MOST_MAPS` ascending ranks below `count`, dense at first and then sparser."""
    ranks: list[int] = []
    rank = 0.0
    while len(ranks) < _MOST_MAPS and round(rank) < count:
        ranks.append(round(rank))
        rank = max(rank + 1.0, rank * _SPREAD)
    return ranks


def image_motions(pose: np.ndarray, poses: np.ndarray, moved: Sequence[np.ndarray]) -> np.ndarray:
    """How images move against a view, as what is static and each moving object see it.

    Args:
        pose: (4, 4) camera to scene-local frame, of the view.
        poses: (k, 4, 4) camera to scene-local frame of each image.
        moved: (k, 4, 4) of each of o objects: its motion in the scene from the view's instant to each
            image's; zeros where it is unknown.

    Returns:
        (o + 1, k, 4, 4) float64 from the view's camera frame to each image's: of what is static, then of each
        object; zeros where it is unknown.
    """
    still = np.broadcast_to(np.eye(4), (1, len(poses), 4, 4))
    by = np.concatenate([still, *(each[None] for each in moved)])
    motions: np.ndarray = invert_pose(poses) @ by @ pose
    return motions * (by[..., 3:, 3:] > 0.0)


def camera_distance_m(motions: np.ndarray) -> np.ndarray:
    """Distance (...) of two cameras by the motion (..., 4, 4) between their frames; inf if it is zeros."""
    return np.where(motions[..., 3, 3] > 0.0, np.linalg.norm(motions[..., :3, 3], axis=-1), np.inf)


def images_near(
    motions: np.ndarray, known: Sequence[int], label: Tensor | None, instant: np.ndarray | None = None
) -> list[int]:
    """Images whose depth maps are carried into a view, the nearest first.

    They are spread by distance. At another time than the view's, an image that sees a moving object as the
    view does may be far away: the largest objects in the view have the images nearest to them, too.

    Args:
        motions: (m, j, 4, 4) of all images, see `image_motions`.
        known: Numbers of the images to choose from, the nearest first.
        label: (H, W) uint8: moving objects in the view, as indices of `motions`, 0 = none; None = none.
        instant: (j,) int64: number of each image's instant, the same for images of several cameras; None =
            one camera's.
    """
    instants = np.arange(len(known)) if instant is None else instant[list(known)]
    _, first, place = np.unique(instants, return_index=True, return_inverse=True)
    nearest = np.sort(first)
    ranks = {int(nearest[rank]) for rank in spread_ranks(len(nearest))}
    ranks.update(np.flatnonzero(np.isin(first[place], nearest[:_BESIDE])).tolist())
    if label is not None:
        distance_m = camera_distance_m(motions[:, known])
        pixels = np.bincount(label.numpy().ravel(), minlength=len(motions))
        largest = 1 + np.argsort(-pixels[1:], kind="stable")[:_MOST_MOVERS]
        for mover in largest[pixels[largest] > 0]:
            nearest = np.argsort(distance_m[mover], kind="stable")[:_MAPS_OF_MOVER]
            ranks.update(nearest[np.isfinite(distance_m[mover, nearest])].tolist())
    return [known[rank] for rank in sorted(ranks)]


def images_beyond(
    pinhole: Pinhole, motions: np.ndarray, chosen: Sequence[int], known: Sequence[int], maps: DepthMaps
) -> list[int]:
    """Images that show what no chosen one does, as a view does that is turned away from those around it.

    Of each, the pixels of its map that show something static are carried into a small view.

    Args:
        pinhole: Intrinsics of the view and of all images.
        motions: (m, j, 4, 4) of all images, see `image_motions`.
        chosen: Numbers of images whose maps are carried into the view already.
        known: Numbers of the images to choose from.
        maps: Of all images.

    Returns:
        The numbers of at most 6 others, those that show most first.
    """
    small = shrunk(pinhole, _SHRUNK)
    rows, columns = (slice(_SHRUNK // 2, _SHRUNK * n, _SHRUNK) for n in (small.height, small.width))
    is_static = maps.mover[:, rows, columns] == 0
    static = torch.where(is_static, maps.inverse[:, rows, columns], 0.0).numpy()
    nothing = np.zeros((small.height, small.width), np.uint8)

    def shown(number: int) -> np.ndarray:
        motion = _inverted(motions[:1, number])
        view, _ = splat_depth_map(static[number], nothing, motion, (small.fx, small.fy, small.cx, small.cy))
        return view > 0.0

    missing = ~np.stack([shown(number) for number in chosen]).any(axis=0)
    least, added = max(1.0, _LEAST_NEW * missing.size), list[int]()
    others = [number for number in known if number not in chosen] if missing.sum() >= least else []
    left = {number: shown(number) for number in others}
    while left and len(added) < _MOST_BEYOND:
        best = max(left, key=lambda number: int((left[number] & missing).sum()))
        new = left.pop(best) & missing
        if new.sum() < least:
            break
        added.append(best)
        missing &= ~new
    return added


def depth_in_view(pinhole: Pinhole, near: NearMaps, expected: Tensor | None) -> ViewDepth:
    """The surfaces that the depth maps of images around a view agree on.

    `expected` (H, W) uint8 is the moving object that returns show at each pixel, an index of the motions; 0
    or None = none is known to be there.
    """
    intrinsics = (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)
    carried = _carried(near, near.inverse, intrinsics)
    unconfirmed = _carried(near, [-inverse for inverse in near.inverse], intrinsics)
    nothing = np.zeros((pinhole.height, pinhole.width), np.uint8)
    depths, support, labels = agreed_depths(
        np.stack([one for one, _ in carried]), np.stack([one for _, one in carried]),
        near.weight, _LEAST_SHARE, nothing if expected is None else expected.numpy(),
    )  # fmt: skip
    known = support[0] > 0.0
    # What a moving object uncovers is static, however near the object is in the image.
    static = known & (labels[0] == 0)
    if not static.any():
        depths[0] = np.where(known, depths[0], 1.0 / FAR_M)
    elif not known.all():
        _, where = nearest_known(static)
        depths[0] = np.where(known, depths[0], depths[0][where[0], where[1]])
    front, is_speckle = smoothed(depths[0], labels[0])
    # A pixel is looked up as one thing: another one behind a moving object is left out.
    is_other = (support[1] > 0.0) & (labels[0] == labels[1])
    support[1] = np.where(is_speckle, _SPECKLE * support[0], np.where(is_other, support[1], 0.0))
    depths[1] = np.where(is_speckle, depths[0], np.where(is_other, depths[1], front))
    depths[0] = front
    glimpsed = np.stack([one > 0.0 for one, _ in unconfirmed]).any(axis=0)
    return ViewDepth(*(torch.from_numpy(each) for each in (depths, support, labels[0], glimpsed)))


def _carried(
    near: NearMaps, inverse: Sequence[np.ndarray], intrinsics: tuple[float, float, float, float]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What is positive in maps (H, W), 1/m, of the images of `near`, each as the view sees it; and labels."""
    return [
        splat_depth_map(one, label, _inverted(near.motions[:, k]), intrinsics)
        for k, (one, label) in enumerate(zip(inverse, near.label, strict=True))
    ]


def _inverted(motions: np.ndarray) -> np.ndarray:
    """(m, 4, 4) the other way; zeros stay."""
    return invert_pose(motions) * (motions[:, 3:, 3:] > 0.0)


def baseline_sources(poses: np.ndarray, own: int, known: Sequence[int], most: int) -> list[int]:
    """Images at several distances from an image: near ones look alike, far ones tell depths apart.

    At most `most`; images that look the other way are not chosen. Of those numbered `known`; poses (j, 4, 4)
    of all are camera to scene-local.
    """
    looks_back = poses[:, :3, 2] @ poses[own][:3, 2] < OTHER_WAY
    left = [number for number in known if number != own and not looks_back[number]]
    chosen: list[int] = []
    for step in range(min(most, len(left))):
        away_m = np.linalg.norm(poses[left][:, :3, 3] - poses[own][:3, 3], axis=1)
        chosen.append(left.pop(int(np.argmin(np.abs(away_m - _NEAREST_BASELINE_M * 2.0**step)))))
    return chosen


def covering_sources(pinhole: Pinhole, surfaces: ViewDepth, near: NearMaps, most: int) -> list[int]:
    """Images that together see most of a view, near ones preferred; the nearest is always one of them.

    At most `most`; their places among the k of `near`, the nearest first, ascending.
    """
    half = _THINNED // 2
    rays = plane_rays(pinhole)[half::_THINNED, half::_THINNED]
    wanted, label = (x[half::_THINNED, half::_THINNED] for x in (surfaces.inverse[0], surfaces.label))
    weight = torch.from_numpy(near.weight)
    worth = torch.stack(
        [
            _seen(near, k, SeenPoints(rays, wanted, label), pinhole) * weight[:, k][label.long()]
            for k in range(len(near.inverse))
        ]
    )
    chosen = [0]
    while len(chosen) < min(most, len(worth)):
        best, second = _two_best(worth[chosen])
        # What each further image would add to the sum of the best and half of the second best of each pixel.
        gain = torch.where(
            worth > best, worth - best + _SECOND * (best - second), _SECOND * (worth - second).clamp_min(0.0)
        )
        gain = (gain + _FIRST * ((best == 0.0) & (worth > 0.0))).sum(dim=(1, 2))
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
    return sorted(chosen)


def _seen(near: NearMaps, k: int, points: SeenPoints, pinhole: Pinhole) -> Tensor:
    """(h, w) bool: the view's points, one of each pixel, that the image k shows."""
    motions = torch.from_numpy(near.motions[:, k].astype(np.float32))
    grid, inside, there = source_pixels(motions[0], points.rays, points.inverse, pinhole)
    seen = inside & ~hides(sample(near.fronts[k][None], grid, "nearest")[0], there)
    assert points.label is not None
    movers = torch.unique(points.label[points.label > 0]).tolist()
    shown = np.stack([near.inverse[k], near.label[k].astype(np.float32)]) if movers else None
    for mover in movers:
        where = points.label == mover
        grid, inside, there = source_pixels(
            motions[mover], points.rays[where], points.inverse[where], pinhole
        )
        own, which = sample(torch.from_numpy(shown), grid[None], "nearest")[:, 0]
        seen[where] = inside & (which == mover) & ~hides(own, there)
    return seen


def _two_best(worth: Tensor) -> tuple[Tensor, Tensor]:
    best = worth.topk(min(2, len(worth)), dim=0).values
    return best[0], best[1] if len(best) > 1 else torch.zeros_like(best[0])
