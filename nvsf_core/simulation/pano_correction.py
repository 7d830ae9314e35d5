"""An expected pano, what its neighbours show, and what a network makes of both."""

from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.numerics import probability_logit
from nvsf_core.recipe import PanoSpec
from nvsf_core.simulation.pano_estimate import PanoEstimate
from nvsf_core.simulation.pano_neighbours import Neighbours

PARTS = ("hit", "intensity")
"""What a network may correct, each by itself: its outputs."""
FEATURES = 16
"""Channels that describe a cell."""
_HIT_LIMIT = 0.01
_INTENSITY_LIMIT = 0.01


def pano_network(spec: PanoSpec, generator: torch.Generator) -> CellNetwork:
    """Untrained; weights are drawn from `generator`."""
    return CellNetwork(FEATURES, len(PARTS), generator, channels=spec.channels, layers=spec.layers)


def cell_features(estimate: PanoEstimate, neighbours: Neighbours) -> Tensor:
    """What the network is told of each cell, (FEATURES, h, w) float32, each about -1..1."""
    near_m, median_m, far_m = estimate.range_m
    height, width = estimate.hit.shape
    level = np.broadcast_to(np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None], (height, width))
    limited = np.clip(estimate.hit, _HIT_LIMIT, 1.0 - _HIT_LIMIT)
    columns = [
        estimate.hit - 0.5,
        np.log(limited / (1.0 - limited)) / 4.0,
        estimate.hit > 0.0,
        median_m / 40.0,
        np.log1p(median_m) / 2.0 - 1.0,
        np.arcsinh(median_m - near_m),
        np.arcsinh(far_m - median_m),
        estimate.intensity,
        estimate.rays / 2.0 - 1.0,
        neighbours.filled - 0.5,
        neighbours.same - 0.5,
        neighbours.through,
        neighbours.empty,
        neighbours.intensity,
        neighbours.offset_m * 2.0,
        level,
    ]
    assert len(columns) == FEATURES
    return torch.from_numpy(np.stack(columns).astype(np.float32))


def hit_prior(estimate: PanoEstimate) -> Tensor:
    """(h, w) logit of the expected hit; cells without any ray have no return to show."""
    return probability_logit(torch.from_numpy(estimate.hit), _HIT_LIMIT)


def intensity_prior(estimate: PanoEstimate) -> Tensor:
    """(h, w) logit of the expected intensity."""
    return probability_logit(torch.from_numpy(estimate.intensity), _INTENSITY_LIMIT)


@torch.no_grad()
def corrected_pano(
    network: CellNetwork, estimate: PanoEstimate, neighbours: Neighbours, parts: Collection[str] = PARTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range in metres, intensity and hit probability (h, w) float32, some `parts` as the network has them.

    The others are the phases': the expected hit, the mean intensity, and always the median range.
    """
    range_m, intensity, hit = phases_alone(estimate)
    hit_logit, intensity_logit = network(cell_features(estimate, neighbours)[None])[0]
    is_shown = range_m > 0.0
    if "intensity" in parts:
        intensity = torch.sigmoid(intensity_prior(estimate) + intensity_logit).numpy() * is_shown
    if "hit" in parts:
        hit = torch.sigmoid(hit_prior(estimate) + hit_logit).numpy() * is_shown
    return range_m, intensity, hit


def phases_alone(estimate: PanoEstimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range in metres, intensity and hit probability (h, w) without a network."""
    return estimate.median_m, estimate.intensity, estimate.hit
