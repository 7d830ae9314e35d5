"""What the nearest recorded panos show beside an estimated one, and the network that corrects it."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.models.residual.pano_estimate import PanoEstimate
from nvsf_core.numerics import probability_logit
from nvsf_core.recipe import PanoSpec
from nvsf_core.sensors.beam_table import turn_up
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import Trajectory, sweep_fraction

_SAME_M, _SAME_SHARE = 0.2, 0.01
"""Two ranges show the same surface if they differ by less than the sum of a length and a share of it."""


@dataclass(frozen=True, slots=True)
class RecordedPanos:
    """Panos of n training scans, projected as recorded, and where their sensor was."""

    time_s: np.ndarray
    """(n,) float64."""
    range_m: np.ndarray
    """(n, h, w) float32, 0 = empty."""
    intensity: np.ndarray
    """(n, h, w) float32."""
    trajectory: Trajectory
    """Of the sensor."""
    period_s: float
    """Of a turn; 0 where all rays are fired at once."""
    turn_up_rad: float
    """How far recorded directions are turned up on their way into the world."""


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Means over the scans that were asked; all (h, w) float32."""

    filled: np.ndarray
    """Share of the scans whose same cell is filled."""
    same: np.ndarray
    """Share of the scans that show the expected surface."""
    through: np.ndarray
    """Share of the scans that saw through it."""
    empty: np.ndarray
    """Share of the scans with nothing there."""
    intensity: np.ndarray
    """Mean intensity of the scans that show the expected surface, 0 where none does."""
    offset_m: np.ndarray
    """Mean of how much farther those scans have it, 0 where none does."""


def ask_neighbours(
    panos: RecordedPanos, scans: np.ndarray, range_m: np.ndarray, time_s: float, pano: LinearPano
) -> Neighbours:
    """Compare an expected pano at a time with some recorded ones.

    Args:
        panos: Recorded.
        scans: (k,) indices of those that are asked, k >= 1.
        range_m: (h, w) expected ranges, 0 = nothing: only `filled` is told there.
        time_s: Instant of the expected pano's pose.
        pano: Layout of all.
    """
    known = range_m > 0.0
    row, column = np.nonzero(known)
    expected_m = range_m[known].astype(np.float64)
    world = _to_scene(panos, pano, row, column, expected_m, time_s)
    found = np.zeros((5, len(row)))
    for scan in scans:
        where, there_m = _cells_in(panos, int(scan), world, pano)
        shown_m = panos.range_m[scan].reshape(-1)[where].astype(np.float64)
        shown_m[where < 0] = 0.0
        offset_m = shown_m - there_m
        same = (shown_m > 0.0) & (np.abs(offset_m) < _SAME_M + _SAME_SHARE * there_m)
        found[0] += same
        found[1] += (shown_m > 0.0) & ~same & (offset_m > 0.0)
        found[2] += (shown_m == 0.0) & (where >= 0)
        found[3] += np.where(same, panos.intensity[scan].reshape(-1)[where], 0.0)
        found[4] += np.where(same, offset_m, 0.0)
    found[3:] /= np.maximum(found[0], 1.0)
    found[:3] /= len(scans)
    images = np.zeros((5, *range_m.shape), np.float32)
    images[:, row, column] = found
    filled = (panos.range_m[scans] > 0.0).mean(axis=0, dtype=np.float32)
    return Neighbours(filled, *images)


def _to_scene(
    panos: RecordedPanos,
    pano: LinearPano,
    row: np.ndarray,
    column: np.ndarray,
    range_m: np.ndarray,
    time_s: float,
) -> np.ndarray:
    """(n, 3) scene-local points of cells, each from where the sensor was when it looked there."""
    direction = pano.directions()
    azimuth = np.arctan2(direction[0, :, 1], direction[0, :, 0])
    points = direction[row, column] * range_m[:, None]
    up, _ = turn_up(points, points, azimuth[column], panos.turn_up_rad)
    rotation, position = panos.trajectory.at(time_s + sweep_fraction(azimuth) * panos.period_s)
    found: np.ndarray = np.einsum("nij,nj->ni", rotation[column], up) + position[column]
    return found


def _cells_in(
    panos: RecordedPanos, scan: int, world: np.ndarray, pano: LinearPano
) -> tuple[np.ndarray, np.ndarray]:
    """Cells (n,) int64 of a recorded scan that look at scene-local points, -1 outside, and ranges there."""
    centre = np.arctan2(*np.swapaxes(pano.directions()[0, :, 1::-1], 0, 1))
    rotation, position = panos.trajectory.at(panos.time_s[scan] + sweep_fraction(centre) * panos.period_s)
    column = np.full(len(world), pano.width // 2)
    for _ in range(2):
        # Where the sensor was when it looked there depends on where there is: the second pass is enough.
        points = np.einsum("nji,nj->ni", rotation[column], world - position[column])
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        column = np.rint((np.pi - azimuth) / (2.0 * np.pi / pano.width)).astype(np.int64) % pano.width
    down, _ = turn_up(points, points, azimuth, -panos.turn_up_rad)
    row, column, range_m, kept = pano.cells(down)
    return np.where(kept, row * pano.width + column, -1), range_m


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
