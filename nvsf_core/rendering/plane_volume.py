"""Plane sweep of the camera networks: colours of the source images on a view's depth planes."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe import CameraSpec
from nvsf_core.rendering.sources import Sources, look_up

_UNSEEN_DIFFERENCE = 0.25
"""Colour difference that is assumed where fewer than two sources show a plane."""
_NEAREST = 2
"""This many nearest sources have weight 1 in a plane's colour."""
_FARTHER_WEIGHT = 0.3
"""Weight of the other sources in a plane's colour."""
_WINDOW_PX = 5
_TRUST_PX = 3.0
"""Distance from a return in the shrunk image over which the trust in its depth falls to 1/e."""
_CLAMP_PLANES = 8.0
_MODE_PLANES = 2
"""Planes on either side of the likeliest that count as the same depth."""


@dataclass(frozen=True, slots=True)
class PlaneVolume:
    """Colours of k sources on d depth planes of a view."""

    colour: Tensor
    """(k, 3, d, h, w) in 0..1."""
    seen: Tensor
    """(k, d, h, w) bool: the source shows the pixel at this depth."""

    def agreement(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """How well the sources agree on each plane.

        Returns:
            Mean difference of all sources to their mean (d, h, w), 0..1; difference of the two nearest ones
            (d, h, w), 0..1; share of sources that show the plane (d, h, w); mean colour (d, 3, h, w).
        """
        shown = self.seen[:, None].float()
        count = shown.sum(dim=0)
        mean = (self.colour * shown).sum(dim=0) / count.clamp_min(1e-6)
        spread = ((self.colour - mean).abs().mean(dim=1) * shown[:, 0]).sum(dim=0)
        count = count[0]
        spread = torch.where(count > 1.5, spread / count.clamp_min(1e-6), _UNSEEN_DIFFERENCE)
        pair = spread
        if len(shown) > 1:
            difference = (self.colour[0] - self.colour[1]).abs().mean(dim=0)
            pair = torch.where(self.seen[0] & self.seen[1], difference, _UNSEEN_DIFFERENCE)
        return spread, pair, count / len(shown), mean.transpose(0, 1)

    def without_first(self) -> "PlaneVolume":
        """The volume of all sources but the first."""
        return PlaneVolume(self.colour[1:], self.seen[1:])

    def mean_colour(self) -> Tensor:
        """Mean colour (d, 3, h, w), mostly of the two nearest sources; 0 where none shows the plane."""
        weight = torch.full((len(self.seen), 1, 1, 1, 1), _FARTHER_WEIGHT, device=self.seen.device)
        weight[:_NEAREST] = 1.0
        weight = weight * self.seen[:, None]
        mean = (weight * self.colour).sum(dim=0) / weight.sum(dim=0).clamp_min(1e-6)
        return mean.transpose(0, 1)


@dataclass(frozen=True, slots=True)
class DepthBelief:
    """Likeliest depths and mean colours of a view's shrunk pixels."""

    inverse: Tensor
    """(2, h, w) inverse depths, 1/m: the likeliest one, and the likeliest away from it."""
    probability: Tensor
    """(2, h, w) of both."""
    colour: Tensor
    """(3, h, w) 0..1, mean over all planes by probability."""


def plane_inverses(spec: CameraSpec, device: torch.device | None = None) -> Tensor:
    """Inverse depths (d,) of the planes, 1/m, ascending, evenly spaced; None = on the CPU."""
    # Always computed on the CPU, so that every device gets the same bits.
    return torch.linspace(1.0 / spec.far_m, 1.0 / spec.near_m, spec.planes).to(device)


def plane_volume(
    sources: Sources, rays: Tensor, pinhole: Pinhole, inverses: Tensor, label: Tensor | None = None
) -> PlaneVolume:
    """Look up every plane in every source.

    Args:
        sources: Source images of the view.
        rays: (h, w, 3) directions (x, y, 1) of the view's pixels, all or a window.
        pinhole: Intrinsics of the source images.
        inverses: (d, 1, 1) inverse depths of planes, or (d, h, w) of each pixel, 1/m.
        label: (h, w) number of the moving object that a pixel shows, 0 = static; None = nothing moves.
    """
    found = [look_up(sources, k, rays, inverses, pinhole, label) for k in range(len(sources.image))]
    return PlaneVolume(torch.stack([colour for colour, _ in found]), torch.stack([seen for _, seen in found]))


def volume_features(volume: PlaneVolume, prior: Tensor, gap_px: Tensor, inverses: Tensor) -> Tensor:
    """Input (VOLUME_FEATURES, d, h, w) of the depth network.

    Args:
        volume: Colours on d planes.
        prior: (h, w) inverse depth from the LiDAR, 1/m.
        gap_px: (h, w) distance to the nearest return in shrunk pixels; inf where there is no return.
        inverses: (d,) inverse depths of the planes, 1/m.
    """
    spread, pair, share, mean = volume.agreement()
    # Without any return the prior is only a placeholder.
    is_known = torch.isfinite(gap_px).float()
    trust = torch.exp(-gap_px / _TRUST_PX)
    offset = (inverses[:, None, None] - prior) / (inverses[1] - inverses[0]) * is_known
    at_prior = torch.exp(-0.5 * offset**2) * is_known
    return torch.stack(
        [
            4.0 * spread,
            4.0 * pair,
            4.0 * _window_mean(spread),
            4.0 * _window_mean(pair),
            share,
            at_prior * trust,
            at_prior * (1.0 - trust),
            offset.clamp(-_CLAMP_PLANES, _CLAMP_PLANES) / _CLAMP_PLANES,
            trust.expand_as(spread),
            *mean.unbind(dim=1),
        ]
    )


def depth_belief(probability: Tensor, mean_colour: Tensor, inverses: Tensor) -> DepthBelief:
    """Find the two likeliest depths of each pixel.

    Args:
        probability: (d, h, w) of the planes.
        mean_colour: (d, 3, h, w) of the planes, 0..1.
        inverses: (d,) inverse depths of the planes, 1/m.
    """
    first = probability.argmax(dim=0)
    apart = (torch.arange(len(inverses), device=first.device)[:, None, None] - first).abs() > _MODE_PLANES + 1
    second = (probability * apart).argmax(dim=0)
    modes = [_mode(probability, index, inverses) for index in (first, second)]
    return DepthBelief(
        inverse=torch.stack([inverse for inverse, _ in modes]),
        probability=torch.stack([mass for _, mass in modes]),
        colour=(probability[:, None] * mean_colour).sum(dim=0),
    )


def _mode(probability: Tensor, index: Tensor, inverses: Tensor) -> tuple[Tensor, Tensor]:
    """Mean inverse depth (h, w) of the planes around plane `index` (h, w), and their probability (h, w)."""
    planes = index + torch.arange(-_MODE_PLANES, _MODE_PLANES + 1, device=index.device)[:, None, None]
    inside = (planes >= 0) & (planes < len(inverses))
    planes = planes.clamp(0, len(inverses) - 1)
    near = probability.gather(0, planes) * inside
    mass = near.sum(dim=0)
    return (near * inverses[planes]).sum(dim=0) / mass.clamp_min(1e-9), mass


def without_holes(colour: Tensor, share: Tensor) -> Tensor:
    """Colours (3, h, w) that are known for a `share`, the rest from ever larger surroundings.

    Args:
        colour: (3, h, w) in 0..1.
        share: (h, w), 0..1.
    """
    return _filled(colour * share, share)


def _filled(weighted: Tensor, share: Tensor) -> Tensor:
    both = torch.cat([weighted, share[None]])
    if min(share.shape) < 2:
        mean = both.mean(dim=(1, 2), keepdim=True)
        around = mean[:3] / mean[3:].clamp_min(1e-6)
    else:
        smaller = functional.avg_pool2d(both[None], 2, ceil_mode=True, count_include_pad=False)[0]
        coarse = _filled(smaller[:3], smaller[3])
        around = functional.interpolate(coarse[None], share.shape, mode="bilinear", align_corners=False)[0]
    return weighted + (1.0 - share) * around


def _window_mean(costs: Tensor) -> Tensor:
    """Mean of costs (d, h, w) over a square window."""
    half = _WINDOW_PX // 2
    return functional.avg_pool2d(costs[None], _WINDOW_PX, 1, half, count_include_pad=False)[0]
