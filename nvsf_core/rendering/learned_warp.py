"""The learned camera: neighbouring images at believed depths, blended by a network."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.fields.camera_networks import BlendNetwork, CameraNetworks, DepthNetwork
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.plane_volume import (
    DepthBelief,
    Sources,
    depth_belief,
    plane_inverses,
    plane_volume,
    volume_features,
)
from nvsf_core.rendering.reproject_camera import nearest_sources, view_depth
from nvsf_core.rendering.warping import plane_rays, relative_motion, sample, shrunk, source_pixels, to_float

_DISTANCE_FLOOR_M = 0.05
_TRUST_PX = 12.0
"""Distance in the image over which a return's depth loses its hold on the blend."""

Window = tuple[slice, slice]
"""Rows and columns of an image."""
WHOLE: Window = (slice(None), slice(None))


@dataclass(frozen=True, slots=True)
class CameraView:
    """Everything that is known about a view before the networks look at it."""

    pinhole: Pinhole
    small: Pinhole
    factor: int
    """Pixels of the image a side of a pixel of the shrunk one."""
    inverse: Tensor
    """(H, W) inverse depth that the LiDAR gives, 1/m."""
    gap_px: Tensor
    """(H, W) distance to the nearest return."""
    images: Tensor
    """(j, 4, H, W) float32, all of the camera, as `shown_images` makes them."""
    chosen: list[int]
    """Images that are looked at, the nearest first; as many as the recipe wants, the last repeated."""
    motion: Tensor
    """(k, 4, 4)."""
    nearness: Tensor
    """(k,)."""

    def sources(self) -> Sources:
        """The images at full resolution."""
        return Sources(tuple(self.images[index] for index in self.chosen), self.motion, self.nearness)

    def small_sources(self) -> Sources:
        """The shrunk images."""
        full = self.sources()
        small = tuple(functional.avg_pool2d(image, self.factor) for image in full.image)
        return Sources(small, self.motion, self.nearness)


def shown_images(images: np.ndarray, valid: np.ndarray) -> Tensor:
    """Images (j, H, W, 3) uint8 and what of them shows anything, (H, W) bool, as sources: (j, 4, H, W)."""
    shown = torch.from_numpy(valid).float().expand(len(images), 1, -1, -1)
    return torch.cat([to_float(images), shown], dim=1)


def camera_view(
    pose: np.ndarray,
    pinhole: Pinhole,
    points_m: np.ndarray,
    images: Tensor,
    poses: np.ndarray,
    spec: CameraSpec,
    *,
    leave_out: int | None = None,
) -> CameraView:
    """Choose sources of a view and look at the LiDAR's depth from it.

    Args:
        pose: (4, 4) camera to scene-local.
        pinhole: Of the view and of all images.
        points_m: (m, 3) float32 scene-local, for depth.
        images: (j, 4, H, W) as `shown_images` makes them.
        poses: (j, 4, 4).
        spec: Of the networks.
        leave_out: Image that may not be a source: the one that the view is compared with.
    """
    depth_m, gap_px = view_depth(pose, pinhole, points_m)
    known = [index for index in range(len(images)) if index != leave_out]
    chosen = [known[index] for index in nearest_sources(pose, poses[known], spec.sources)]
    distances = np.linalg.norm(poses[chosen][:, :3, 3] - pose[:3, 3], axis=1) + _DISTANCE_FLOOR_M
    nearness = torch.zeros(spec.sources)
    nearness[: len(chosen)] = torch.from_numpy((distances[0] / distances).astype(np.float32))
    chosen += [chosen[-1]] * (spec.sources - len(chosen))
    factor = max(1, round((pinhole.width * pinhole.height / spec.plane_px) ** 0.5))
    return CameraView(
        pinhole=pinhole,
        small=shrunk(pinhole, factor),
        factor=factor,
        inverse=torch.from_numpy(1.0 / depth_m),
        gap_px=torch.from_numpy(gap_px),
        images=images,
        chosen=chosen,
        motion=torch.stack([relative_motion(pose, poses[index]) for index in chosen]),
        nearness=nearness,
    )


def planes_of(
    network: DepthNetwork, view: CameraView, sources: Sources, spec: CameraSpec, window: Window = WHOLE
) -> tuple[Tensor, Tensor]:
    """Probability (d, h, w) and colour (d, 3, h, w) of the planes of shrunk pixels.

    Args:
        network: Says which planes to believe.
        view: What is looked at.
        sources: Its shrunk images.
        spec: Of the networks.
        window: Of the shrunk image.
    """
    inverses = plane_inverses(spec)
    volume = plane_volume(sources, plane_rays(view.small)[window], view.small, inverses)
    prior, gap_px = (_thinned(x, view)[window] for x in (view.inverse, view.gap_px))
    features = volume_features(volume, prior, gap_px / view.factor, inverses)
    return network(features).softmax(dim=0), volume.mean_colour()


@torch.no_grad()
def believe_depth(network: DepthNetwork, view: CameraView, spec: CameraSpec) -> DepthBelief:
    """What the whole view's shrunk pixels are believed to show."""
    probability, colour = planes_of(network, view, view.small_sources(), spec)
    return depth_belief(probability, colour, plane_inverses(spec))


def blend_sources(
    network: BlendNetwork, view: CameraView, belief: DepthBelief, window: Window = WHOLE
) -> Tensor:
    """Colour (3, h, w), about 0..1, of a window of the view."""
    rays = plane_rays(view.pinhole)[window]
    channels = sample(belief.stacked(), _places_in_shrunk(view)[window])
    inverse, probability, coarse = channels[:2], channels[2:4], channels[4:]
    hypotheses = torch.cat([inverse, view.inverse[window][None]])
    sources = view.sources()
    found, shown = [], []
    for image, motion, nearness in zip(sources.image, sources.motion, sources.nearness, strict=True):
        grid, inside = source_pixels(motion, rays, hypotheses, view.pinhole)
        looked_up = sample(image, grid.flatten(0, 1)).reshape(4, *hypotheses.shape)
        found.append(looked_up[:3])
        shown.append(inside & (looked_up[3] > 0.999) & (nearness > 0))
    trust = torch.exp(-view.gap_px[window] / _TRUST_PX)
    return network(
        torch.stack(found, dim=0).permute(2, 0, 1, 3, 4).flatten(0, 1),
        torch.stack(shown, dim=1).flatten(0, 1),
        torch.cat([probability, trust[None]]),
        coarse,
        view.nearness,
    )


@torch.no_grad()
def render_view(networks: CameraNetworks, view: CameraView, spec: CameraSpec) -> np.ndarray:
    """The whole view, (H, W, 3) uint8."""
    colour = blend_sources(networks.blend, view, believe_depth(networks.depth, view, spec))
    image = (colour.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    return image.permute(1, 2, 0).contiguous().numpy()


def _thinned(image: Tensor, view: CameraView) -> Tensor:
    """An image's (H, W) middle pixel of each shrunk one."""
    half, step = view.factor // 2, view.factor
    return image[half::step, half::step][: view.small.height, : view.small.width]


def _places_in_shrunk(view: CameraView) -> Tensor:
    """grid_sample's coordinates (H, W, 2) of the image's pixels in the shrunk one."""
    row = (torch.arange(view.pinhole.height) + 0.5) / view.factor * 2.0 / view.small.height - 1.0
    column = (torch.arange(view.pinhole.width) + 0.5) / view.factor * 2.0 / view.small.width - 1.0
    return torch.stack(torch.meshgrid(row, column, indexing="ij")[::-1], dim=-1)
