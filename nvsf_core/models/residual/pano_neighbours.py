"""The pano network: corrects an estimated pano by comparing it with the nearest recorded ones."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.fields.layers import CellNetwork
from nvsf_core.models.residual.pano_estimate import PanoEstimate
from nvsf_core.numerics import probability_logit
from nvsf_core.sensors.beam_table import turn_up
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import Trajectory, sweep_fraction
from nvsf_core.sensors.sweep_clock import SweepClock

_SAME_M, _SAME_SHARE = 0.2, 0.01
"""Two ranges are of the same surface if they differ by less than 0.2 m plus 1 % of the range."""


@dataclass(frozen=True, slots=True)
class RecordedPanos:
    """Panos of n training scans, projected as recorded, and the sensor's poses."""

    time_s: np.ndarray
    """(n,) float64."""
    range_m: np.ndarray
    """(n, h, w) float32, metres, 0 = empty."""
    intensity: np.ndarray
    """(n, h, w) float32."""
    trajectory: Trajectory
    """Of the sensor."""
    period_s: float
    """Of a sweep; 0 where all rays are fired at once."""
    clocks: tuple[SweepClock, ...]
    """(n,) when in each scan's sweep an azimuth is measured."""
    turn_up_rad: float
    """Angle by which recorded directions are turned up on their way into the world."""


@dataclass(frozen=True, slots=True)
class Neighbours:
    """The comparison of each cell with k recorded panos; all (h, w) float32."""

    filled: np.ndarray
    """Share of the panos whose same cell is not empty."""
    same: np.ndarray
    """Share of the panos that show the expected surface."""
    through: np.ndarray
    """Share of the panos with a return behind it."""
    empty: np.ndarray
    """Share of the panos with an empty cell there."""
    intensity: np.ndarray
    """Mean intensity of the panos that show the expected surface; 0 where none does."""
    offset_m: np.ndarray
    """Mean of how much farther away these panos have it, metres; 0 where none does."""


def ask_neighbours(
    panos: RecordedPanos, scans: np.ndarray, range_m: np.ndarray, time_s: float, pano: LinearPano
) -> Neighbours:
    """Compare an estimated pano with some recorded ones.

    Args:
        panos: Recorded.
        scans: (k,) indices of those to compare with, k >= 1.
        range_m: (h, w) expected ranges, 0 = empty: there only `filled` is computed.
        time_s: Time of the estimated pano's pose.
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
    """Scene-local points (n, 3) of cells at given ranges, each from the sensor's pose at the cell's time."""
    direction = pano.directions()
    azimuth = np.arctan2(direction[0, :, 1], direction[0, :, 0])
    points = direction[row, column] * range_m[:, None]
    up, _ = turn_up(points, points, azimuth[column], panos.turn_up_rad)
    clock = panos.clocks[int(np.abs(panos.time_s - time_s).argmin())]
    elapsed = clock.elapsed(sweep_fraction(azimuth))
    rotation, position = panos.trajectory.at(time_s + elapsed * panos.period_s)
    return np.einsum("nij,nj->ni", rotation[column], up) + position[column]


def _cells_in(
    panos: RecordedPanos, scan: int, world: np.ndarray, pano: LinearPano
) -> tuple[np.ndarray, np.ndarray]:
    """Cells (n,) int64 of a recorded scan towards scene-local points (n, 3), -1 outside, and their ranges."""
    centre = np.arctan2(*np.swapaxes(pano.directions()[0, :, 1::-1], 0, 1))
    elapsed = panos.clocks[scan].elapsed(sweep_fraction(centre))
    rotation, position = panos.trajectory.at(panos.time_s[scan] + elapsed * panos.period_s)
    column = np.full(len(world), pano.width // 2)
    for _ in range(2):
        # Azimuth and the sensor's pose at that azimuth depend on each other; two passes are enough.
        points = np.einsum("nji,nj->ni", rotation[column], world - position[column])
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        column = np.rint((np.pi - azimuth) / (2.0 * np.pi / pano.width)).astype(np.int64) % pano.width
    down, _ = turn_up(points, points, azimuth, -panos.turn_up_rad)
    row, column, range_m, kept = pano.cells(down)
    return np.where(kept, row * pano.width + column, -1), range_m


PARTS = ("hit", "intensity")
"""The outputs of the network; each is used or not by itself."""
FEATURES = 16
"""Input channels of the network."""
_HIT_LIMIT = 0.01
_INTENSITY_LIMIT = 0.01


def cell_features(estimate: PanoEstimate, neighbours: Neighbours) -> Tensor:
    """The network's input (FEATURES, h, w) float32, each channel about -1..1."""
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
    """Logit (h, w) of the expected hit probability, limited to 0.01..0.99."""
    return probability_logit(torch.from_numpy(estimate.hit), _HIT_LIMIT)


def intensity_prior(estimate: PanoEstimate) -> Tensor:
    """Logit (h, w) of the expected intensity, limited to 0.01..0.99."""
    return probability_logit(torch.from_numpy(estimate.intensity), _INTENSITY_LIMIT)


@torch.no_grad()
def corrected_pano(
    network: CellNetwork, estimate: PanoEstimate, neighbours: Neighbours, parts: Collection[str] = PARTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range in metres, intensity and hit probability (h, w) float32, those in `parts` corrected.

    The range is always the estimate's median.
    """
    range_m, intensity, hit = phases_alone(estimate)
    hit_logit, intensity_logit = network.corrections(cell_features(estimate, neighbours))
    is_shown = range_m > 0.0
    if "intensity" in parts:
        intensity = torch.sigmoid(intensity_prior(estimate) + intensity_logit).numpy() * is_shown
    if "hit" in parts:
        hit = torch.sigmoid(hit_prior(estimate) + hit_logit).numpy() * is_shown
    return range_m, intensity, hit


def phases_alone(estimate: PanoEstimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median range in metres, intensity and hit probability (h, w) float32 of the estimate."""
    return estimate.median_m, estimate.intensity, estimate.hit
