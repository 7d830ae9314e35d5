"""The learned camera: neighbouring images at believed depths, blended by a network."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.fields.camera_networks import CameraEnsemble, CameraNetworks, DepthNetwork, RefineNetwork
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.camera_view import WHOLE, CameraView, Window, middle_factor
from nvsf_core.rendering.plane_volume import (
    DepthBelief,
    depth_belief,
    plane_inverses,
    plane_volume,
    volume_features,
)
from nvsf_core.rendering.rendered import RenderedImage
from nvsf_core.rendering.sources import look_up
from nvsf_core.rendering.warping import plane_rays, ray_length, sample

_TRUST_PX = 12.0
"""Distance in the image over which a return's depth loses its hold on the blend."""
_FINER = 0.25
"""Step between refined depths, of that between planes."""
_JUMP = 1.0
"""Planes between believed depths side by side from which on they are two surfaces, with nothing between."""


def planes_of(
    network: DepthNetwork, view: CameraView, spec: CameraSpec, window: Window = WHOLE
) -> tuple[Tensor, Tensor]:
    """Probability (d, h, w) and colour (d, 3, h, w) of the planes of shrunk pixels.

    Args:
        network: Says which planes to believe.
        view: What is looked at.
        spec: Of the networks.
        window: Of the shrunk image.
    """
    inverses, small = plane_inverses(spec), view.small
    label = view.label_of(view.factor, window)
    sources = view.sources(view.images.small)
    volume = plane_volume(sources, plane_rays(small)[window], small, inverses[:, None, None], label)
    prior, gap_px = (view.thinned(x, view.factor)[window] for x in (view.inverse, view.gap_px))
    features = volume_features(volume, prior, gap_px / view.factor, inverses)
    return network(features).softmax(dim=0), volume.mean_colour()


@torch.no_grad()
def believe_depth(network: DepthNetwork, view: CameraView, spec: CameraSpec) -> DepthBelief:
    """What the whole view's shrunk pixels are believed to show."""
    probability, colour = planes_of(network, view, spec)
    return depth_belief(probability, colour, plane_inverses(spec))


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """The depths at which a view's pixels are looked up in its sources."""

    inverse: Tensor
    """(3, h, w) 1/m: the two that images agree on best, and the LiDAR's."""
    share: Tensor
    """(3, h, w) in 0..1, how far each is believed."""

    def resized(self, places: Tensor, jump: float) -> "Hypotheses":
        """The same at other places: between pixels of one surface the mean, at an edge the nearest pixel's.

        A mean across an edge would be a depth where nothing is, and draw it as a line.

        Args:
            places: (h, w, 2) in grid_sample's coordinates.
            jump: 1/m, from which on depths side by side are two surfaces.
        """
        both = torch.cat([self.inverse, self.share])
        mean, near = sample(both, places), sample(both, places, "nearest")
        is_edge = (mean - near)[: len(self.inverse)].abs() > jump
        inverse, share = torch.where(is_edge.repeat(2, 1, 1), near, mean).chunk(2)
        return Hypotheses(inverse, share)


@dataclass(frozen=True, slots=True)
class Refinement:
    """Depths around hypotheses, compared."""

    hypotheses: Hypotheses
    """Moved to where they are believed."""
    probability: Tensor
    """(c, h, w) of every depth that was compared."""
    colour: Tensor
    """(c, 3, h, w) mean of the sources there."""


@dataclass(frozen=True, slots=True)
class Blend:
    """Sources, blended."""

    colour: Tensor
    """(3, h, w), about 0..1."""
    hypotheses: Hypotheses
    """Where they were looked up."""
    refinement: Refinement | None
    """What refining depths was like; None for a recipe without."""


def hypotheses(
    view: CameraView, belief: DepthBelief, spec: CameraSpec, factor: int, window: Window
) -> Hypotheses:
    """What is believed of a window of the view shrunk by `factor`; the LiDAR's word first where it reaches.

    Args:
        view: What is looked at.
        belief: Of all its shrunk pixels.
        spec: Of the networks.
        factor: 1 for the image itself.
        window: Of the image that is `factor` times smaller.
    """
    places = _places(view, factor, view.factor)[window]
    believed = Hypotheses(belief.inverse, belief.probability).resized(places, _JUMP * _plane_step(spec))
    inverse, gap_px = (view.thinned(x, factor)[window] for x in (view.inverse, view.gap_px))
    trust = torch.exp(-gap_px / _TRUST_PX)
    return Hypotheses(
        torch.cat([believed.inverse, inverse[None]]),
        torch.cat([believed.share * (1.0 - trust), trust[None]]),
    )


def refine(
    network: RefineNetwork, view: CameraView, coarse: Hypotheses, spec: CameraSpec, window: Window = WHOLE
) -> Refinement:
    """Compare depths around each hypothesis on images of the middle size.

    Args:
        network: Says which to believe.
        view: What is looked at.
        coarse: Of the window's pixels.
        spec: Of the networks.
        window: Of the image of the middle size.
    """
    count = spec.refinements
    offsets = (torch.arange(count) - count // 2) * _FINER * _plane_step(spec)
    depths = (coarse.inverse.detach()[:, None] + offsets[:, None, None]).clamp_min(0.0).flatten(0, 1)
    middle = view.middle
    label = view.label_of(middle_factor(view.factor), window)
    volume = plane_volume(view.sources(view.images.middle), plane_rays(middle)[window], middle, depths, label)
    spread, pair, shown, _ = volume.agreement()
    probability = network(spread, pair, shown, coarse.share)
    each = probability.reshape(-1, count, *probability.shape[1:])
    share = each.sum(dim=1)
    steps = depths.reshape(each.shape) - coarse.inverse.detach()[:, None]
    moved = (each * steps).sum(dim=1) / share.clamp_min(1e-6)
    return Refinement(Hypotheses(coarse.inverse + moved, share), probability, volume.mean_colour())


def blend_sources(
    networks: CameraNetworks,
    view: CameraView,
    belief: DepthBelief,
    spec: CameraSpec,
    window: Window = WHOLE,
    around: Window = WHOLE,
) -> Blend:
    """Show a window of the view.

    Args:
        networks: That blend and, where the recipe wants it, refine.
        view: What is shown.
        belief: Of all its shrunk pixels.
        spec: Of the networks.
        window: Of the view.
        around: Of the shrunk view, holds the window: where depths are refined.
    """
    refinement = None
    if networks.refine is None:
        found = hypotheses(view, belief, spec, 1, window)
    else:
        part = scaled(around, view.factor // middle_factor(view.factor))
        coarse_depths = hypotheses(view, belief, spec, _middle(view), part)
        refinement = refine(networks.refine, view, coarse_depths, spec, part)
        places = _places(view, 1, _middle(view), part)[window]
        found = refinement.hypotheses.resized(places, _JUMP * _plane_step(spec))
    coarse = sample(belief.colour, _places(view, 1, view.factor)[window])
    label = view.label_of(1, window)
    sources, rays = view.sources(view.images.full), plane_rays(view.pinhole)[window]
    looked_up = [
        look_up(sources, k, rays, found.inverse, view.pinhole, label) for k in range(len(view.chosen))
    ]
    colour = networks.blend(
        torch.stack([colour for colour, _ in looked_up]).permute(2, 0, 1, 3, 4).flatten(0, 1),
        torch.stack([seen for _, seen in looked_up], dim=1).flatten(0, 1),
        found.share,
        coarse,
        view.nearness,
    )
    return Blend(colour, found, refinement)


@torch.no_grad()
def render_view(networks: CameraEnsemble, view: CameraView, spec: CameraSpec) -> RenderedImage:
    """The whole view, the mean of what the members show.

    A pixel is as far away as the depth that a member believes most; of several members', the median.
    """
    colours, depths = [], []
    for member in networks:
        blend = blend_sources(member, view, believe_depth(member.depth, view, spec), spec)
        found = blend.hypotheses
        colours.append(blend.colour)
        depths.append(found.inverse.gather(0, found.share.argmax(dim=0, keepdim=True))[0])
    image = (torch.stack(colours).mean(dim=0).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    believed = torch.stack(depths).median(dim=0).values
    return RenderedImage(
        image.permute(1, 2, 0).contiguous().numpy(), ray_length(believed, view.pinhole).numpy()
    )


def _plane_step(spec: CameraSpec) -> float:
    """Inverse depth between two planes, 1/m."""
    return (1.0 / spec.near_m - 1.0 / spec.far_m) / (spec.planes - 1)


def _middle(view: CameraView) -> int:
    return middle_factor(view.factor)


def scaled(window: Window, by: int) -> Window:
    """The same part of an image `by` times as large."""
    rows, columns = (
        side if side == slice(None) else slice(side.start * by, side.stop * by) for side in window
    )
    return rows, columns


def _places(view: CameraView, factor: int, shrunk_by: int, part: Window = WHOLE) -> Tensor:
    """Where the pixels of the view `factor` times smaller lie in a window of that `shrunk_by` times smaller.

    grid_sample's coordinates (h, w, 2) in the window.
    """
    sides = []
    for length, side in zip((view.pinhole.height, view.pinhole.width), part, strict=True):
        first, last, _ = side.indices(length // shrunk_by)
        place = (torch.arange(length // factor) + 0.5) * factor / shrunk_by - first
        sides.append(place * 2.0 / (last - first) - 1.0)
    return torch.stack(torch.meshgrid(*sides, indexing="ij")[::-1], dim=-1)
