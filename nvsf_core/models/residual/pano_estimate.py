"""Estimates a pano as the mean over firing phases, because a sweep's firings start at a random azimuth.

A recorded pano keeps the nearest return of each cell. Which rays fall into a cell depends on the phase of
the firings, which is random. Rays i of one phase in a cell, ordered by range, return with probability p_i;
the cell then shows ray i with probability p_i prod_{j nearer} (1 - p_j), and nothing with prod (1 - p_i).
All phases are equally likely.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import SweepRays

QUANTILES = (0.15, 0.5, 0.85)
"""Quantiles of the range that are estimated for each cell: a near one, the median, a far one."""
_MOST_HIT = 1.0 - 1e-7

Fire = Callable[[float], tuple[SweepRays, RenderedRays]]
"""Given a phase of the firings, 0..1, the rays of a sweep, rendered."""


@dataclass(frozen=True, slots=True)
class PanoRays:
    """n rays that fall into cells of a pano."""

    cell: np.ndarray
    """(n,) int64: row x width + column."""
    range_m: np.ndarray
    """(n,) float64 from the sensor's centre."""
    hit: np.ndarray
    """(n,) float64: hit probability."""
    intensity: np.ndarray
    """(n,) float64, 0..1."""


@dataclass(frozen=True, slots=True)
class PanoEstimate:
    """The estimate of each cell of a pano; all arrays (h, w) float32 if not said otherwise."""

    hit: np.ndarray
    """Probability that the cell shows a return."""
    range_m: np.ndarray
    """(3, h, w) metres: `QUANTILES` of the range that the cell shows; 0 where it shows nothing."""
    intensity: np.ndarray
    """Mean intensity that the cell shows; 0 where it shows nothing."""
    rays: np.ndarray
    """Number of rays that fall into the cell, mean over phases."""

    @property
    def median_m(self) -> np.ndarray:
        """(h, w) median range in metres."""
        return np.asarray(self.range_m[1])


def estimate_pano(fire: Fire, pano: LinearPano, phases: int, *, parts: int = 1) -> PanoEstimate:
    """Simulate sweeps at evenly spaced phases and combine them.

    Args:
        fire: Simulates a sweep.
        pano: Layout of the cells.
        phases: Number of simulated sweeps.
        parts: Number of phases that each sweep stands for. For the others its points are turned about the
            sensor's axis by a part of the angle between two phases.
    """
    found = []
    for number in range(phases):
        rays, rendered = fire((number + 0.5) / phases)
        firing_rad = 2.0 * np.pi / rays.shape[1]
        for part in range(parts):
            # Later firings look farther to the right.
            turn_rad = -firing_rad * ((part + 0.5) / parts - 0.5) / phases
            found.append(rays_in_cells(pano, rays, rendered, turn_rad))
    return combine_phases(found, pano)


def rays_in_cells(
    pano: LinearPano, rays: SweepRays, rendered: RenderedRays, turn_rad: float = 0.0
) -> PanoRays:
    """The rays of a sweep in the cells where their points would be recorded, turned left by `turn_rad`."""
    known = np.isfinite(rendered.range_m) & (rendered.hit > 0.0)
    points = rays.recorded_origin_m[known] + rays.recorded_direction[known] * rendered.range_m[known, None]
    if turn_rad != 0.0:
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        points[:, :2] = points[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    row, column, range_m, kept = pano.cells(points)
    return PanoRays(
        cell=(row * pano.width + column)[kept],
        range_m=range_m[kept],
        hit=np.clip(rendered.hit[known][kept].astype(np.float64), 0.0, _MOST_HIT),
        intensity=np.clip(rendered.intensity[known][kept].astype(np.float64), 0.0, 1.0),
    )


def combine_phases(phases: Sequence[PanoRays], pano: LinearPano) -> PanoEstimate:
    """The estimate from equally likely phases; formula in the module's docstring."""
    cells = pano.height * pano.width
    weighed = [_shown(rays) for rays in phases]
    cell, range_m, intensity, weight = (np.concatenate(columns) for columns in zip(*weighed, strict=True))
    weight = weight / len(phases)
    hit = np.bincount(cell, weights=weight, minlength=cells)
    bright = np.bincount(cell, weights=weight * intensity, minlength=cells)
    count = np.bincount(cell, minlength=cells) / len(phases)
    order = np.lexsort((range_m, cell))
    cell, range_m, weight = cell[order], range_m[order], weight[order]
    ranges = np.zeros((len(QUANTILES), cells))
    if len(cell):
        below = np.cumsum(weight)
        before = np.concatenate([[0.0], below])[np.searchsorted(cell, cell)]
        share = (below - before) / np.maximum(hit[cell], 1e-300)
        last = np.append(cell[1:] != cell[:-1], True)
        for number, quantile in enumerate(QUANTILES):
            reached = np.flatnonzero((share >= quantile) | last)
            # Written from the farthest to the nearest, so that the nearest that reaches the quantile is kept.
            ranges[number, cell[reached[::-1]]] = range_m[reached[::-1]]
    bright = np.divide(bright, hit, out=np.zeros(cells), where=hit > 0.0)
    shape = (pano.height, pano.width)
    return PanoEstimate(
        hit=hit.reshape(shape).astype(np.float32),
        range_m=ranges.reshape(-1, *shape).astype(np.float32),
        intensity=bright.reshape(shape).astype(np.float32),
        rays=count.reshape(shape).astype(np.float32),
    )


def _shown(rays: PanoRays) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cell, range, intensity and probability to be the one shown, each (n,), of the rays of one phase."""
    order = np.lexsort((rays.range_m, rays.cell))
    cell, hit = rays.cell[order], rays.hit[order]
    missed = np.cumsum(np.log1p(-hit))
    before = np.concatenate([[0.0], missed])
    through = np.exp(before[:-1] - before[np.searchsorted(cell, cell)])
    return cell, rays.range_m[order], rays.intensity[order], hit * through
