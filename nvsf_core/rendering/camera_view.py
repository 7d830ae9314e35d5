"""A view before the networks look at it: which images show it, the LiDAR's depth, and what moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.reproject_camera import nearest_sources, view_depth, view_label
from nvsf_core.rendering.sources import Sources
from nvsf_core.rendering.warping import relative_motion, shrunk, to_float

_DISTANCE_FLOOR_M = 0.05
_REACH_PX = 6.0
"""Distance in the image from a moving object's return up to which a pixel is taken for the object's."""
_SHADOW_PX = 10.0
"""The same where a source image must not be looked at for what stands still."""

Window = tuple[slice, slice]
"""Rows and columns of an image."""
WHOLE: Window = (slice(None), slice(None))


@dataclass(frozen=True, slots=True)
class ShownImages:
    """All images of a camera in three sizes, (j, c, ...) float32 with the channels of `Sources.image`."""

    full: Tensor
    middle: Tensor
    small: Tensor

    def mirrored(self) -> "ShownImages":
        """With left and right exchanged."""
        return ShownImages(self.full.flip(-1), self.middle.flip(-1), self.small.flip(-1))


@dataclass(frozen=True, slots=True, eq=False)
class MovingPoints:
    """A moving object as a view needs it."""

    points_m: np.ndarray
    """(m, 3) float32 scene-local at the view's instant."""
    moved: np.ndarray
    """(j, 4, 4) its motion in the scene from that instant to each image's; zeros where it is not known."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """Everything that is known about a view before the networks look at it."""

    pinhole: Pinhole
    factor: int
    """Pixels of the image a side of a pixel of the shrunk one."""
    inverse: Tensor
    """(H, W) inverse depth that the LiDAR gives, 1/m."""
    gap_px: Tensor
    """(H, W) distance to the nearest return."""
    images: ShownImages
    """All of the camera."""
    chosen: list[int]
    """Images that are looked at, the nearest first; as many as the recipe wants, the last repeated."""
    motion: Tensor
    """(k, 4, 4)."""
    nearness: Tensor
    """(k,)."""
    moved: Tensor | None = None
    """(o, k, 4, 4), see `Sources`."""
    label: Tensor | None = None
    """(H, W) uint8, 1 and more for the moving object that a pixel shows; None = nothing moves."""

    @property
    def small(self) -> Pinhole:
        """Of the images on which planes are compared."""
        return shrunk(self.pinhole, self.factor)

    @property
    def middle(self) -> Pinhole:
        """Of the images on which depths are refined."""
        return shrunk(self.pinhole, middle_factor(self.factor))

    def sources(self, images: Tensor) -> Sources:
        """The view's among all images, of whatever size."""
        chosen = tuple(images[index] for index in self.chosen)
        return Sources(chosen, self.motion, self.nearness, self.moved)

    def mirrored(self) -> "CameraView":
        """The same scene with x exchanged for -x in every camera's frame, and what is then seen of it."""
        flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))
        return replace(
            self,
            pinhole=replace(self.pinhole, cx=self.pinhole.width - 1 - self.pinhole.cx),
            inverse=self.inverse.flip(-1),
            gap_px=self.gap_px.flip(-1),
            images=self.images.mirrored(),
            motion=flip @ self.motion @ flip,
            moved=None if self.moved is None else flip @ self.moved @ flip,
            label=None if self.label is None else self.label.flip(-1),
        )

    def thinned(self, image: Tensor, factor: int) -> Tensor:
        """An image's (H, W) middle pixel of each of those that are `factor` times as large."""
        half = factor // 2
        rows, columns = self.pinhole.height // factor, self.pinhole.width // factor
        return image[half::factor, half::factor][:rows, :columns]

    def label_of(self, factor: int, window: Window) -> Tensor | None:
        """The labels of a window of the shrunk view; None where nothing moves."""
        return None if self.label is None else self.thinned(self.label, factor)[window]


def shrinking(pinhole: Pinhole, spec: CameraSpec) -> int:
    """How many times smaller the images are on which planes are compared: even, or 1."""
    return max(1, 2 * round(0.5 * (pinhole.width * pinhole.height / spec.plane_px) ** 0.5))


def middle_factor(factor: int) -> int:
    """The shrinking of images on which depths are refined: they have twice the planes' resolution."""
    return max(1, factor // 2)


def shown_images(
    images: np.ndarray, valid: np.ndarray, factor: int, moving: np.ndarray | None = None
) -> ShownImages:
    """Images as sources.

    Args:
        images: (j, H, W, 3) uint8.
        valid: (H, W) bool, pixels that show anything.
        factor: Shrinking of the images on which planes are compared.
        moving: (j, H, W) bool, pixels that show what moves; None = nothing does.
    """
    shown = torch.from_numpy(valid).float().expand(len(images), 1, -1, -1)
    parts = [to_float(images), shown]
    if moving is not None:
        parts.append(torch.from_numpy(moving).float()[:, None])
    full = torch.cat(parts, dim=1)
    middle, small = (functional.avg_pool2d(full, by) for by in (middle_factor(factor), factor))
    return ShownImages(full, middle, small)


def moving_pixels(
    pose: np.ndarray, pinhole: Pinhole, static_m: np.ndarray, moving_m: Sequence[np.ndarray]
) -> np.ndarray:
    """Pixels (H, W) bool of a recorded image that may show what moves, from points at its instant."""
    return view_label(pose, pinhole, [static_m, *moving_m], _SHADOW_PX) > 0


def camera_view(
    pose: np.ndarray,
    pinhole: Pinhole,
    points_m: np.ndarray,
    images: ShownImages,
    poses: np.ndarray,
    spec: CameraSpec,
    *,
    leave_out: int | None = None,
    moving: Sequence[MovingPoints] = (),
) -> CameraView:
    """Choose sources of a view and look at the LiDAR's depth from it.

    Args:
        pose: (4, 4) camera to scene-local.
        pinhole: Of the view and of all images.
        points_m: (m, 3) float32 scene-local, for depth; without what moves.
        images: All of the camera, shrunk as `shrinking` says.
        poses: (j, 4, 4) theirs.
        spec: Of the networks.
        leave_out: Image that may not be a source: the one that the view is compared with.
        moving: What moves and may be seen.
    """
    clouds = [points_m, *(thing.points_m for thing in moving)]
    depth_m, gap_px = view_depth(pose, pinhole, np.concatenate(clouds))
    known = [index for index in range(len(poses)) if index != leave_out]
    chosen = [known[index] for index in nearest_sources(pose, poses[known], spec.sources)]
    distances = np.linalg.norm(poses[chosen][:, :3, 3] - pose[:3, 3], axis=1) + _DISTANCE_FLOOR_M
    nearness = torch.zeros(spec.sources)
    nearness[: len(chosen)] = torch.from_numpy((distances[0] / distances).astype(np.float32))
    chosen += [chosen[-1]] * (spec.sources - len(chosen))
    label = view_label(pose, pinhole, clouds, _REACH_PX) if moving else None
    return CameraView(
        pinhole=pinhole,
        factor=shrinking(pinhole, spec),
        inverse=torch.from_numpy(1.0 / depth_m),
        gap_px=torch.from_numpy(gap_px),
        images=images,
        chosen=chosen,
        motion=torch.stack([relative_motion(pose, poses[index]) for index in chosen]),
        nearness=nearness,
        moved=_moved(pose, poses[chosen], [thing.moved[chosen] for thing in moving]) if moving else None,
        label=None if label is None else torch.from_numpy(label),
    )


def _moved(pose: np.ndarray, sources: np.ndarray, moved: Sequence[np.ndarray]) -> Tensor:
    motions = [[invert_pose(to) @ by @ pose for to, by in zip(sources, each, strict=True)] for each in moved]
    return torch.from_numpy(np.array(motions, np.float32))
