"""The pano's seam, poles and rows out of view; scans sampled from a grid."""

import math

import numpy as np

from benchmarks.numerics.cases.case import Case, Reading, refused
from nvsf_core.errors import DataError
from nvsf_core.metrics.hit import hit_cells
from nvsf_core.sensors.linear_pano import LinearPano, nearest_in_cells
from nvsf_core.simulation.raydrop import sharpen_hits
from nvsf_core.simulation.scan import GRID_ARRAYS, sample_scan

TITLE = "Panos, grids and sampled scans"
_PANO = LinearPano()


def _seam() -> str:
    tiny = [0.0, -0.0, 1e-300, -1e-300, 1e-12, -1e-12, 1e-4, -1e-4]
    _, column, _, kept = _PANO.cells(np.array([[-10.0, y, -1.0] for y in tiny]))
    assert bool(kept.all()) and set(column.tolist()) == {0}, f"columns {column}, kept {kept}"
    return "column 0, all kept"


def _half_turn() -> float:
    """(x, y) to (-x, -y), exact in floats, rolls the pano by half its columns; share of cells that differ."""
    ends = [-math.pi, -0.43, 3.0], [math.pi, 0.03, 79.0]
    azimuth, elevation, range_m = np.random.default_rng(0).uniform(*ends, (120_000, 3)).T
    azimuth[:4000] = np.tile([0.0, -0.0, math.pi, -math.pi], 1000)
    across = range_m * np.cos(elevation)
    x, y, z = across * np.cos(azimuth), across * np.sin(azimuth), range_m * np.sin(elevation)
    there, turned = (_PANO.project(np.stack([s * x, s * y, z], axis=1), azimuth)[0] for s in (1.0, -1.0))
    return float((np.roll(there, _PANO.width // 2, axis=1) != turned).mean())


def _ties() -> float:
    """Of equally near returns the first stays, as Python's min has it."""
    rng = np.random.default_rng(0)
    cell, ranges = rng.integers(0, 500, 50_000), rng.integers(1, 40, 50_000).astype(np.float32)
    first = [min(np.flatnonzero(cell == c), key=ranges.__getitem__, default=-1) for c in range(501)]
    return float((nearest_in_cells(cell, ranges, 501) != first).sum())


def _poles() -> str:
    low = math.radians(_PANO.fov_deg - _PANO.fov_up_deg)
    points = np.array([
        [0, 0, 5.0], [0, 0, -5.0], [0, 0, 0], [1e-30, 0, 5.0], [5.0, 0, 5 * math.tan(math.radians(3.0))],
        [5.0, 0, -5 * math.tan(low + 0.02)], [0, 0, 1e-200], [80.0, 0, 0], [79.999, 0, 0], [200.0, 0, 0],
    ])  # fmt: skip
    row, column, _, kept = _PANO.cells(points)
    assert kept.tolist() == [False] * 8 + [True, False], f"kept {kept}"
    assert bool(((column >= 0) & (column < _PANO.width)).all()), f"columns {column}"
    return f"only the point within view and range is kept, in row {row[8]}"


def _inverse(pano: LinearPano, may_lose: bool) -> Reading:
    points = pano.points(np.full((pano.height, pano.width), 20.0, np.float32))
    row, column, _, kept = pano.cells(points)
    rows, columns = (a.ravel() for a in np.mgrid[0 : pano.height, 0 : pano.width])
    assert may_lose or bool(kept.all()), f"{(~kept).sum()} cells lost"
    wrong = (row != rows) | (column % pano.width != columns)
    return Reading(error=float(wrong.sum()), outcome=f"{(~kept).sum()} cells lost")


def _hit_cells() -> str:
    """The turn of a tiny negative azimuth rounds to exactly 1."""
    points = np.array([[1, 0, 0], [1, -1e-300, 0], [1, -1e-20, 0], [-1, 0.0, 0], [-1, -0.0, 0], [0, 0, 0]])
    filled = np.flatnonzero(hit_cells(points, np.zeros(6, np.int64), (1, 2000))[0]).tolist()
    assert set(filled) <= {0, 999, 1000, 1999}, f"cells {filled}"
    return f"cells {filled}"


def _sharpened() -> float:
    rng = np.random.default_rng(0)
    given = (np.zeros(1000), np.ones(1000), np.full(1000, 0.5), rng.random(1000), np.repeat([0.0, 1.0], 500),
             10.0 ** rng.uniform(-12, 0, 1000))  # fmt: skip
    return max(abs(float(sharpen_hits(p).mean() - np.clip(p, 1e-6, 1 - 1e-6).mean())) for p in given)


def _drawn(**changed: float) -> np.ndarray:
    """A scan of 4 lasers of 40 firings that see a wall, but for what is changed."""
    values = dict.fromkeys(GRID_ARRAYS, 0.0) | {"grid_range_m": 10.0, "grid_hit": 0.9, "grid_intensity": 0.5}
    grid = {name: np.full((4, 40), value, np.float32) for name, value in (values | changed).items()}
    azimuth = np.linspace(-np.pi, np.pi, 40, endpoint=False, dtype=np.float32)
    return sample_scan(grid | {"grid_azimuth_rad": np.tile(azimuth, (4, 1))}, np.random.default_rng(0))[0]


def _nothing_there() -> str:
    empty = [len(_drawn(grid_range_m=math.inf)), len(_drawn(grid_range_m=0.0)), len(_drawn(grid_hit=0.0))]
    full = _drawn(grid_intensity=7.0)
    assert bool(np.isfinite(full).all()) and full[:, 3].max() <= 1.0 and len(full) > 0, f"{full}"
    assert empty == [0, 0, 0], f"points {empty}"
    return f"points {empty}, {len(full)}"


_LINEAR, _SAMPLE = "sensors.linear_pano.LinearPano", "simulation.scan.sample_scan"
_NEAREST = "sensors.linear_pano.nearest_in_cells"
CASES = (
    Case(f"{_LINEAR}.cells", "azimuth ±180 degrees ± 1e-300 .. 1e-5", _seam),
    # A few points lie on a border between columns to within the rounding of their azimuth.
    Case(f"{_LINEAR}.project", "a scene turned by 180 degrees, azimuths ±0 and ±pi: the pano rolls by half",
         _half_turn, 1e-4, "of the cells"),
    Case(f"{_LINEAR}.cells", "poles, centre, rows and ranges just out of view", _poles),
    Case(f"{_LINEAR}.points", "each cell's point falls into it", lambda: _inverse(_PANO, False)),
    Case(f"{_LINEAR}.points", "the same with the papers' quirks, which discard half a column",
         lambda: _inverse(LinearPano(reference_quirks=True), True)),
    Case("metrics.hit.hit_cells", "azimuth 0, -1e-300, ±180 degrees, the centre", _hit_cells),
    Case("simulation.raydrop.sharpen_hits", "sum of hits: all 0, all 1, 1e-12 to 1", _sharpened, 1e-6),
    Case(_SAMPLE, "range inf and 0, hit 0, intensity 7", _nothing_there),
    Case(_SAMPLE, "hit NaN (outside)", refused(DataError, lambda: _drawn(grid_hit=math.nan))),
    Case(_SAMPLE, "range NaN (outside)", refused(DataError, lambda: _drawn(grid_range_m=math.nan))),
    Case(_SAMPLE, "intensity NaN (outside)", refused(DataError, lambda: _drawn(grid_intensity=math.nan))),
    Case(f"{_LINEAR}.cells", "NaN (outside)",
         refused(DataError, lambda: _PANO.cells(np.array([[math.nan, 0.0, 0.0]])))),
    Case(_NEAREST, "ties: 50,000 returns of 39 ranges in 500 of 501 cells", _ties, 0.0, "cells"),
    Case(_NEAREST, "range NaN (outside)",
         refused(DataError, lambda: nearest_in_cells(np.array([0, 0]), np.array([1.0, math.nan]), 1))),
)  # fmt: skip
