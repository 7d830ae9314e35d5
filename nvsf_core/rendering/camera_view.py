"""What a view is made from, of the images around it: source images, depths, and moving objects."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.rendering.image_exposure import recorded_at_exposure
from nvsf_core.rendering.lidar_view import LidarView, MovingPoints
from nvsf_core.rendering.reproject_camera import nearest_sources
from nvsf_core.rendering.sources import DEPTH, MOVING, SHOWN, Neighbours
from nvsf_core.rendering.view_depth_maps import (
    DepthMaps,
    NearMaps,
    ViewDepth,
    baseline_sources,
    camera_distance_m,
    covering_sources,
    depth_in_view,
    image_motions,
    images_beyond,
    images_near,
)
from nvsf_core.rendering.warping import shrunk

_DISTANCE_FLOOR_M = 0.05
_IN_FRONT = 1e3
"""Inverse depth, 1/m, of pixels that show nothing static: it hides everything."""

Window = tuple[slice, slice]
"""Rows and columns of an image."""
WHOLE: Window = (slice(None), slice(None))


@dataclass(frozen=True, slots=True)
class ShownImages:
    """All j images of one or more cameras in two sizes, with the channels of `Sources.images`."""

    full: Tensor
    """(j, c, H, W) float32, as recorded."""
    small: Tensor
    """(j, c, h, w) float32, shrunk by `shrinking`: depth planes are compared on these."""
    depths: DepthMaps | None = None
    """What the images' channel of inverse depths is made from, on the CPU; None = not known yet, the channel
    is 0."""
    fronts: Tensor | None = None
    """(j, H, W) inverse depths, 1/m, on the CPU, that hide what is behind them in each image; None as
    above."""

    def with_depths(self, maps: DepthMaps) -> "ShownImages":
        """The same images with their depth maps."""
        full = self.full.clone()
        full[:, DEPTH] = maps.inverse.clamp_min(0.0)
        nothing_static = full[:, SHOWN] < 0.999
        if self.moving is not None:
            # What maps show of an object reaches beyond its returns.
            full[:, MOVING] = torch.maximum(full[:, MOVING], (maps.mover > 0).float())
            nothing_static = nothing_static | (full[:, MOVING] > 0.5)
        fronts = torch.where(nothing_static, _IN_FRONT, full[:, DEPTH])
        factor = full.shape[-1] // self.small.shape[-1]
        return ShownImages(full, functional.avg_pool2d(full, factor), maps, fronts)

    @property
    def moving(self) -> Tensor | None:
        """(j, H, W) bool: pixels that may show moving objects; None = nothing moves."""
        return self.full[:, MOVING] > 0.5 if self.full.shape[1] > MOVING else None

    def to(self, device: torch.device) -> "ShownImages":
        """The same images, without depths, on `device`."""
        return ShownImages(self.full.to(device), self.small.to(device))


@dataclass(frozen=True, slots=True)
class CameraView:
    """What a view is made from: or, of a recorded image itself, what its depth is found by."""

    pinhole: Pinhole
    """Intrinsics of the view and of all images."""
    factor: int
    """By how much the small images are shrunk: see `shrinking`."""
    inverse: Tensor
    """(H, W) inverse depth from the LiDAR, 1/m."""
    gap_px: Tensor
    """(H, W) distance to the nearest return in the image."""
    images: ShownImages
    """All images of the camera."""
    near: Neighbours
    """The k source images, the nearest first; in a view of an image itself that one, then others at growing
    distances. If there are fewer, the last is repeated."""
    others: Neighbours | None = None
    """The other images whose depth maps are carried into the view: they are asked where no source shows
    anything. None if there are none."""
    surfaces: ViewDepth | None = None
    """What the images' depth maps show; None where the images have none."""
    log_gain: float = 0.0
    """Natural logarithm of the view's exposure over the common one of the images, see `at_exposure`."""
    off_path_m: float = 0.0
    """Distance from the path on which the images were taken, metres."""
    label: Tensor | None = None
    """(H, W) uint8: 0 = static, 1 and more = number of the moving object; None = nothing moves."""

    def to(self, device: torch.device) -> "CameraView":
        """The same view of a recorded image itself, whose depth is found on `device`."""
        return replace(
            self,
            inverse=self.inverse.to(device),
            gap_px=self.gap_px.to(device),
            images=self.images.to(device),
            near=self.near.to(device),
            label=None if self.label is None else self.label.to(device),
        )

    @property
    def device(self) -> torch.device:
        """The device of all its tensors."""
        return self.inverse.device

    @property
    def small(self) -> Pinhole:
        """Intrinsics of the images on which planes are compared."""
        return shrunk(self.pinhole, self.factor)

    def thinned(self, image: Tensor) -> Tensor:
        """The middle pixel of each block of factor x factor pixels of an image (..., H, W)."""
        factor, half = self.factor, self.factor // 2
        rows, columns = self.pinhole.height // factor, self.pinhole.width // factor
        return image[..., half::factor, half::factor][..., :rows, :columns]

    def label_of(self, window: Window = WHOLE) -> Tensor | None:
        """Labels (h, w) in a window of the shrunk view; None = nothing moves."""
        return None if self.label is None else self.thinned(self.label)[window]


def shrinking(pinhole: Pinhole, spec: CameraSpec) -> int:
    """By how much images are shrunk for the comparison of planes: even, or 1."""
    return max(1, 2 * round(0.5 * (pinhole.width * pinhole.height / spec.plane_px) ** 0.5))


def shown_images(
    images: np.ndarray,
    valid: np.ndarray,
    factor: int,
    moving: np.ndarray | None = None,
    log_gain: np.ndarray | None = None,
) -> ShownImages:
    """Convert recorded images to source images of two sizes.

    Args:
        images: (j, H, W, 3) uint8.
        valid: (H, W) bool, pixels that show anything.
        factor: By how much the small images are shrunk.
        moving: (j, H, W) bool, pixels that show moving objects; None = nothing moves.
        log_gain: (j,) natural logarithms of the images' exposures, which are evened; None = all are the same.
    """
    gains = [0.0] * len(images) if log_gain is None else log_gain.tolist()
    colours = torch.stack([recorded_at_exposure(one, -gain) for one, gain in zip(images, gains, strict=True)])
    shown = torch.from_numpy(valid).float().expand(len(images), 1, -1, -1)
    parts = [colours, shown, torch.zeros_like(shown)]
    if moving is not None:
        parts.append(torch.from_numpy(moving).float()[:, None])
    # A pixel's channels beside each other, as looked up.
    full = torch.cat(parts, dim=1).contiguous(memory_format=torch.channels_last)
    return ShownImages(full, functional.avg_pool2d(full, factor))


# Wide: the view (pose, pinhole), its returns and the source images are independent inputs.
def camera_view(
    pose: np.ndarray,
    pinhole: Pinhole,
    lidar: LidarView,
    images: ShownImages,
    poses: np.ndarray,
    spec: CameraSpec,
    *,
    instant: np.ndarray | None = None,
    leave_out: Collection[int] = (),
    own: int | None = None,
    moving: Sequence[MovingPoints] = (),
) -> CameraView:
    """Choose the source images of a view and carry their depths into it.

    Args:
        pose: (4, 4) camera to scene-local frame.
        pinhole: Intrinsics of the view and of all images.
        lidar: What returns show in the view.
        images: All j images of the camera, shrunk by `shrinking`.
        poses: (j, 4, 4) camera to scene-local frame of each image.
        spec: Recipe of the cameras.
        instant: As in `images_near`.
        leave_out: Numbers of images that must not be sources, such as the one that the view is compared with.
        own: Number of the image that the view is of, whose depth is wanted: it is the first source; others
            are chosen at several distances from it.
        moving: Moving objects that may be visible, as `lidar` was made with.
    """
    # Where nothing moves now, sources may still show what did: their pixels of it are no static surface.
    label = lidar.label if images.full.shape[1] > MOVING else None
    known = [index for index in range(len(poses)) if index not in leave_out]
    known = [known[index] for index in nearest_sources(pose, poses[known], len(known))]
    motions = image_motions(pose, poses, [each.moved for each in moving])
    surfaces, chosen, others = None, known[: spec.sources], list[int]()
    if own is not None:
        chosen = [own, *baseline_sources(poses, own, known, spec.sources - 1)]
    elif images.depths is not None:
        near = images_near(motions, known, label, instant)
        beyond = images_beyond(pinhole, motions, near, known, images.depths)
        numbers = [number for number in known if number in near or number in beyond]
        maps = _near_maps(images, motions, numbers, moving)
        surfaces = depth_in_view(pinhole, maps, label)
        if label is not None:
            surfaces = surfaces.completed(label, lidar.inverse)
            label = surfaces.label
        chosen = [numbers[place] for place in covering_sources(pinhole, surfaces, maps, spec.sources)]
        others = [number for number in numbers if number not in chosen]
    return CameraView(
        pinhole=pinhole,
        factor=shrinking(pinhole, spec),
        inverse=lidar.inverse,
        gap_px=lidar.gap_px,
        surfaces=surfaces,
        images=images,
        near=_neighbours(motions, chosen, spec.sources),
        others=_neighbours(motions, others, len(others)) if others else None,
        label=label,
    )


def _neighbours(motions: np.ndarray, chosen: list[int], most: int) -> Neighbours:
    """The images `chosen`, at least one, the last repeated up to `most`; motions (m, j, 4, 4) of all."""
    distances = camera_distance_m(motions[0, chosen]) + _DISTANCE_FLOOR_M
    nearness = torch.zeros(most)
    nearness[: len(chosen)] = torch.from_numpy((distances[0] / distances).astype(np.float32))
    padded = chosen + [chosen[-1]] * (most - len(chosen))
    to_each = torch.from_numpy(motions[:, padded].astype(np.float32))
    return Neighbours(padded, to_each[0], nearness, to_each[1:] if len(to_each) > 1 else None)


def _near_maps(
    images: ShownImages, motions: np.ndarray, numbers: Sequence[int], moving: Sequence[MovingPoints]
) -> NearMaps:
    """Depth maps of the images `numbers`; labels are places in `moving`, from 1."""
    maps, fronts = images.depths, images.fronts
    assert maps is not None and fronts is not None
    inverse, mover = ([x[k].numpy() for k in numbers] for x in (maps.inverse, maps.mover))
    most = max(*(int(one.max()) for one in mover), *(each.number for each in moving), 0)
    # An object that is not in the view has the last motion, of zeros.
    place = np.full(most + 1, len(moving) + 1, np.uint8)
    place[0] = 0
    for number, each in enumerate(moving, start=1):
        place[each.number] = number
    near = np.concatenate([motions[:, numbers], np.zeros((1, len(numbers), 4, 4))])
    return NearMaps(near, inverse, [place[one] for one in mover], [fronts[k] for k in numbers])


def places_in_small(view: CameraView) -> Tensor:
    """Places (H, W, 2) of all pixels of the view in its shrunk images, in grid_sample's coordinates."""
    sides = []
    for length in (view.pinhole.height, view.pinhole.width):
        place = (torch.arange(length, device=view.device) + 0.5) / view.factor
        sides.append(place * 2.0 / (length // view.factor) - 1.0)
    return torch.stack(torch.meshgrid(*sides, indexing="ij")[::-1], dim=-1)
