"""Depth of a recorded image: a network compares the images around it on depth planes."""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.fields.depth_network import DepthNetwork
from nvsf_core.kernels.images.plane_features import describe_planes
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.rendering.camera_view import WHOLE, CameraView, Window, places_in_small
from nvsf_core.rendering.plane_volume import Agreement, agreement
from nvsf_core.rendering.sources import SeenPoints
from nvsf_core.rendering.warping import plane_rays, sample

_WINDOW_PX = 5
_TRUST_PX = 3.0
"""Distance from a return in the shrunk image over which the trust in its depth falls to 1/e."""
_FULL_TRUST_PX = 6.0
"""The same in the full image, where the return's depth replaces that of the planes."""
_COLOUR_SCALE = 4.0
"""Of differences of colours, which are mostly below a quarter."""
_CLAMP_PLANES = 8.0
_MODE_PLANES = 2
"""Planes on either side of the likeliest that count as the same depth."""


def plane_step(spec: CameraSpec) -> float:
    """Inverse depth between two planes, 1/m; depths of neighbours that differ by more are of two surfaces."""
    return (1.0 / spec.near_m - 1.0 / spec.far_m) / (spec.planes - 1)


def plane_inverses(spec: CameraSpec, device: torch.device | None = None) -> Tensor:
    """Inverse depths (d,) of the planes, 1/m, ascending, evenly spaced; None = on the CPU."""
    # Always computed on the CPU, so that every device gets the same bits.
    return torch.linspace(1.0 / spec.far_m, 1.0 / spec.near_m, spec.planes).to(device)


def planes_of(
    network: DepthNetwork,
    view: CameraView,
    spec: CameraSpec,
    window: Window = WHOLE,
) -> tuple[Tensor, Tensor]:
    """Probability (d, h, w) and colour (d, 3, h, w) of a recorded image's d depth planes, at shrunk pixels.

    The image itself is the first source: planes are compared with it, but their colours are the others'.
    """
    inverses, small = plane_inverses(spec, view.device), view.small
    points = SeenPoints(
        plane_rays(small, view.device)[window], inverses[:, None, None], view.label_of(window)
    )
    agreed = agreement(view.near.of(view.images.small), points, small, first=1)
    prior, gap_px = (view.thinned(x)[window] for x in (view.inverse, view.gap_px))
    logits: Tensor = network(plane_features(agreed, prior, gap_px / view.factor, inverses))
    return logits.softmax(dim=0), agreed.colour


def plane_features(agreed: Agreement, prior: Tensor, gap_px: Tensor, inverses: Tensor) -> Tensor:
    """Input (d, N_FEATURES, h, w) of the depth network for d planes, channels last in memory.

    Of inverse depths (h, w) from the LiDAR and (d,) of the planes, 1/m, and the distance (h, w) to the
    nearest return in shrunk pixels, inf where there is no return.
    """
    # Without any return the prior is only a placeholder.
    is_known = torch.isfinite(gap_px).float()
    trust = torch.exp(-gap_px / _TRUST_PX)
    if prior.device.type == "cpu":
        prior_a, trust_a, known_a = (x.contiguous().numpy() for x in (prior, trust, is_known))
        found = describe_planes(
            agreed.found.numpy(), (prior_a, trust_a, known_a), inverses.numpy(),
            (np.float32(_COLOUR_SCALE), np.float32(_CLAMP_PLANES)), _WINDOW_PX // 2,
        )  # fmt: skip
        return torch.from_numpy(found).permute(0, 3, 1, 2)
    return _plane_features(agreed, prior, trust, is_known, inverses)


def _plane_features(
    agreed: Agreement, prior: Tensor, trust: Tensor, is_known: Tensor, inverses: Tensor
) -> Tensor:
    """The same on any device; `trust` (h, w) in the LiDAR's depth, `is_known` (h, w) 1 where it has one."""
    spread, pair, share, *mean = agreed.found.unbind(dim=-1)
    offset = (inverses[:, None, None] - prior) / (inverses[1] - inverses[0]) * is_known
    at_prior = torch.exp(-0.5 * offset**2) * is_known
    features = [
        _COLOUR_SCALE * spread,
        _COLOUR_SCALE * pair,
        _COLOUR_SCALE * _window_mean(spread),
        _COLOUR_SCALE * _window_mean(pair),
        share,
        at_prior * trust,
        at_prior * (1.0 - trust),
        offset.clamp(-_CLAMP_PLANES, _CLAMP_PLANES) / _CLAMP_PLANES,
        trust.expand_as(offset),
        *mean,
    ]
    return torch.stack(features, dim=-1).permute(0, 3, 1, 2)


def likeliest_depth(probability: Tensor, inverses: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse depth (h, w), 1/m, around the likeliest of d planes, and the probability (h, w) of these."""
    planes = (
        probability.argmax(dim=0)
        + torch.arange(-_MODE_PLANES, _MODE_PLANES + 1, device=probability.device)[:, None, None]
    )
    inside = (planes >= 0) & (planes < len(inverses))
    planes = planes.clamp(0, len(inverses) - 1)
    near = probability.gather(0, planes) * inside
    mass = near.sum(dim=0)
    return (near * inverses[planes]).sum(dim=0) / mass.clamp_min(1e-9), mass


@torch.no_grad()
def image_inverse_depth(network: DepthNetwork, view: CameraView, spec: CameraSpec) -> Tensor:
    """Inverse depth (H, W), 1/m, of a recorded image; near returns the LiDAR's."""
    trust = torch.exp(-view.gap_px / _FULL_TRUST_PX)
    inverses, places = plane_inverses(spec, view.device), places_in_small(view)
    probability, _ = planes_of(network, view, spec)
    both = torch.stack(likeliest_depth(probability, inverses))
    inverse, mass = resized(both, places, plane_step(spec))
    return torch.where(trust > mass * (1.0 - trust), view.inverse, inverse)


def resized(layers: Tensor, places: Tensor, jump: float) -> Tensor:
    """Resample a depth and what belongs to it: bilinear on a surface, the nearest pixel at an edge.

    A mean across an edge would be a depth where nothing is, visible as a line.

    Args:
        layers: (2, h, w): inverse depths, 1/m, and another value of each.
        places: (H, W, 2) in grid_sample's coordinates.
        jump: 1/m; where both samplings of the depth differ by more there is an edge.
    """
    mean, near = sample(layers, places), sample(layers, places, "nearest")
    return torch.where((mean - near)[0].abs() > jump, near, mean)


def _window_mean(costs: Tensor) -> Tensor:
    """Mean of costs (d, h, w) over a square window."""
    half = _WINDOW_PX // 2
    return functional.avg_pool2d(costs[:, None], _WINDOW_PX, 1, half, count_include_pad=False)[:, 0]
