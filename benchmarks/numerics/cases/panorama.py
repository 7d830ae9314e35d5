"""The pano's seam, poles and rows out of view; equal ranges in one cell."""

import math

import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Reading, refused
from nvsf_core.errors import DataError, ShapeError
from nvsf_core.losses.gradient_mask import double_gradient_mask
from nvsf_core.metrics.hit import hit_cells
from nvsf_core.sensors.beam_table import BeamPano
from nvsf_core.sensors.linear_pano import LinearPano, nearest_in_cells
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.raydrop import sharpen_hits
from nvsf_core.simulation.scan import GRID_ARRAYS, sample_scan

TITLE = "Panos, grids and sampled scans"
_PANO = LinearPano()


def _street(count: int = 120_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), np.deg2rad(rng.uniform(-24.8, 2.0, count))
    ranges = rng.uniform(3.0, 79.0, count)
    flat = ranges * np.cos(elevation)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)], axis=1)
    return points, rng.random(count)


def _half_turn() -> Reading:
    """(x, y) to (-x, -y), exact in floats: the pano has to roll by half its columns."""
    points, intensity = _street()
    turned = points * np.array([-1.0, -1.0, 1.0])
    wrong = 0
    images = [_PANO.project(p, intensity)[0] for p in (points, turned)]
    wrong = int((np.roll(images[0], _PANO.width // 2, axis=1) != images[1]).sum())
    share = wrong / images[0].size
    return Reading(
        error=share, limit=1e-4, unit="of the cells",
        outcome=f"{wrong} of {images[0].size:,} cells differ: their point lies on a border to 1e-15",
    )  # fmt: skip


def _seam() -> Reading:
    """Points at azimuth ±pi and its neighbours in float, y = +0 and -0: one column, column 0."""
    tiny = [0.0, -0.0, 1e-300, -1e-300, 1e-12, -1e-12, 1e-4, -1e-4]
    points = np.array([[-10.0, y, -1.0] for y in tiny])
    _, column, _, kept = _PANO.cells(points)
    whole = bool(kept.all()) and set(column.tolist()) == {0}
    return Reading(outcome=f"columns {sorted(set(column.tolist()))}, all kept: {whole}", is_refuted=not whole)


def _poles() -> Reading:
    """Straight up and down, the centre itself, rows just out of view: left out, and never wrapped."""
    low = math.radians(_PANO.fov_deg - _PANO.fov_up_deg)
    points = np.array([
        [0, 0, 5.0], [0, 0, -5.0], [0, 0, 0], [1e-30, 0, 5.0], [5.0, 0, 5 * math.tan(math.radians(3.0))],
        [5.0, 0, -5 * math.tan(low + 0.02)], [0, 0, 1e-200], [80.0, 0, 0], [79.999, 0, 0], [200.0, 0, 0],
    ])  # fmt: skip
    row, column, _, kept = _PANO.cells(points)
    only = kept.tolist() == [False] * 8 + [True, False]
    bounded = bool(((column >= 0) & (column < _PANO.width)).all())
    outcome = f"only the point within view and range is kept: {only}; row {int(row[8])}"
    return Reading(outcome=outcome, is_refuted=not (only and bounded))


def _equal_ranges() -> Reading:
    """Of equally near returns the first stays, as in a plain loop; bit-equal on 5e4 returns in 500 cells."""
    rng = np.random.default_rng(0)
    cell, ranges = rng.integers(0, 500, 50_000), rng.integers(1, 40, 50_000).astype(np.float32)
    found = nearest_in_cells(cell, ranges, 501)
    expected = np.full(501, -1)
    for k, (c, r) in enumerate(zip(cell, ranges, strict=True)):
        if expected[c] < 0 or r < ranges[expected[c]]:
            expected[c] = k
    return Reading(error=float((found != expected).sum()), limit=0.0, unit="cells")


def _inverse(reference_quirks: bool) -> Reading:
    """A cell's own point falls into that cell, every cell of the pano."""
    pano = LinearPano(reference_quirks=reference_quirks)
    ranges = np.full((pano.height, pano.width), 20.0, np.float32)
    points = pano.points(ranges)
    row, column, _, kept = pano.cells(points)
    rows, columns = (a.ravel() for a in np.mgrid[0 : pano.height, 0 : pano.width])
    wrong = (row != rows) | (column % pano.width != columns)
    lost = int((~kept).sum())
    return Reading(
        error=float(wrong.sum()), limit=0.0, unit="cells",
        outcome=f"{lost} cells lost" + (": the papers' discarded half column" if reference_quirks else ""),
        is_refuted=lost > 0 and not reference_quirks,
    )  # fmt: skip


def _beam_pano() -> Reading:
    """Laser rows: each filled cell's point goes back into it, also at the seam."""
    pano = BeamPano(HDL_64E)
    ranges = np.full((64, pano.width), 15.0, np.float32)
    points = pano.points(ranges)
    laser = np.repeat(np.arange(64), pano.width)
    found, _ = pano.project(points, np.ones(len(points)), laser)
    return Reading(error=float(np.abs(found - ranges).max()), limit=1e-5, unit="m")


def _hit_cells() -> Reading:
    """Azimuths of 0, ±pi, and a tiny negative one, whose turn rounds to exactly 1."""
    points = np.array([[1, 0, 0], [1, -1e-300, 0], [1, -1e-20, 0], [-1, 0.0, 0], [-1, -0.0, 0], [0, 0, 0]])
    hit = hit_cells(points, np.zeros(6, np.int64), 1)
    filled = np.flatnonzero(hit[0]).tolist()
    return Reading(outcome=f"cells {filled}", is_refuted=not set(filled) <= {0, 999, 1000, 1999})


def _mask() -> Reading:
    """Gradient masks on a seam of a drop, on constant ranges, on one pixel."""
    flat = torch.full((66, 1030), 20.0)
    flat[:, 0] = 0.0
    along_x, along_y = double_gradient_mask(flat, 0.1)
    one = double_gradient_mask(torch.full((1, 1), 5.0), 0.1)
    sound = not bool(along_x[:, 0].any()) and bool(along_y[:, 5:].all()) and not bool(one[0].any())
    return Reading(outcome="drops outside, planes inside, one pixel has no gradient", is_refuted=not sound)


def _sharpened() -> Reading:
    """The expected number of hits is kept, from all 0 to all 1."""
    rng = np.random.default_rng(0)
    worst = 0.0
    for p in (np.zeros(1000), np.ones(1000), np.full(1000, 0.5), rng.random(1000), np.repeat([0.0, 1.0], 500),
              10.0 ** rng.uniform(-12, 0, 1000)):  # fmt: skip
        q = sharpen_hits(p)
        worst = max(worst, abs(float(q.mean()) - float(np.clip(p, 1e-6, 1 - 1e-6).mean())))
    return Reading(error=worst, limit=1e-6, unit="share of rays")


def _grid(**changed: float) -> dict[str, np.ndarray]:
    values = {"grid_range_m": 10.0, "grid_hit": 0.9, "grid_intensity": 0.5} | changed
    azimuth = np.linspace(-np.pi, np.pi, 40, endpoint=False)
    grid = {name: np.full((4, 40), values.get(name, 0.0), np.float32) for name in GRID_ARRAYS}
    return grid | {"grid_azimuth_rad": np.tile(azimuth, (4, 1)).astype(np.float32)}


def _drawn() -> Reading:
    """Nothing there, range 0, no hit: no point. The rest is finite, with an intensity of 0 to 1."""
    empty = [
        len(sample_scan(_grid(**{name: value}), np.random.default_rng(0)))
        for name, value in (("grid_range_m", math.inf), ("grid_range_m", 0.0), ("grid_hit", 0.0))
    ]
    full = sample_scan(_grid(grid_intensity=7.0), np.random.default_rng(0))
    sound = empty == [0, 0, 0] and bool(np.isfinite(full).all()) and float(full[:, 3].max()) <= 1.0
    return Reading(outcome=f"points {empty}, {len(full)}", is_refuted=not sound or len(full) == 0)


def _drawn_nan(name: str) -> Reading:
    return refused(DataError, lambda: sample_scan(_grid(**{name: math.nan}), np.random.default_rng(0)))


_LINEAR = "sensors.linear_pano.LinearPano"
CASES = (
    Case(f"{_LINEAR}.project", "a scene turned by 180 degrees gives the rolled pano", _half_turn),
    Case(f"{_LINEAR}.cells", "azimuth ±180 degrees ± 1e-300 .. 1e-5", _seam),
    Case(f"{_LINEAR}.cells", "poles, centre, rows and ranges just out of view", _poles),
    Case(f"{_LINEAR}.points", "each cell's point falls into it", lambda: _inverse(False)),
    Case(f"{_LINEAR}.points", "the same with the papers' quirks", lambda: _inverse(True)),
    Case("sensors.beam_table.BeamPano", "each cell's point falls into it", _beam_pano),
    Case("sensors.project.nearest_in_cells", "equal ranges in one cell, 5e4 returns", _equal_ranges),
    Case("metrics.hit.hit_cells", "azimuth 0, -1e-300, ±180 degrees, the centre", _hit_cells),
    Case("losses.gradient_mask.double_gradient_mask", "constant ranges, a drop, one pixel", _mask),
    Case("simulation.raydrop.sharpen_hits", "probabilities all 0, all 1, 1e-12 to 1", _sharpened),
    Case("simulation.sampled_scan.sample_scan", "range inf and 0, hit 0, intensity 7", _drawn),
    Case("simulation.sampled_scan.sample_scan", "hit NaN (outside)", lambda: _drawn_nan("grid_hit")),
    Case("simulation.sampled_scan.sample_scan", "range NaN (outside)", lambda: _drawn_nan("grid_range_m")),
    Case(
        "simulation.sampled_scan.sample_scan", "intensity NaN (outside)",
        lambda: _drawn_nan("grid_intensity"),
    ),
    Case(
        f"{_LINEAR}.cells", "NaN (outside)",
        lambda: refused(DataError, lambda: _PANO.cells(np.array([[math.nan, 0.0, 0.0]]))),
    ),
    Case(
        "sensors.project.nearest_in_cells", "range NaN (outside)",
        lambda: refused(DataError, lambda: nearest_in_cells(np.array([0, 0]), np.array([1.0, math.nan]), 1)),
    ),
    Case(
        f"{_LINEAR}.points", "an image of another size (outside)",
        lambda: refused(ShapeError, lambda: _PANO.points(np.zeros((2, 2)))),
    ),
)  # fmt: skip
