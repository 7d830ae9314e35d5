"""Evidence after no and after a million observations, and along degenerate rays."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from benchmarks.numerics.cases.case import Case, Reading, largest, refused
from benchmarks.numerics.cases.tolerances import ELEMENTWISE_ULP, EPS
from nvsf_core.errors import DataError
from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.surfels import Surfels, build_surfels, candidates_of, weighted_median_index
from nvsf_core.fields.lidar_field import surface_batch
from nvsf_core.geometry.voxels import index_points

TITLE = "Evidence"


def _wall(rays: int = 4000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays from around the origin to a wall ahead (plane x = 10.03): origins, directions, ranges."""
    rng = np.random.default_rng(0)
    origins = rng.normal(0.0, 0.5, (rays, 3))
    targets = np.stack([np.full(rays, 10.03), rng.uniform(-4, 4, rays), rng.uniform(-2, 2, rays)], axis=1)
    ranges = np.linalg.norm(targets - origins, axis=1)
    return origins, (targets - origins) / ranges[:, None], ranges


def _surfels(
    origins: np.ndarray, directions: np.ndarray, ranges: np.ndarray, voxel_m: float = 0.25,
    *, joined: bool = True,
) -> Surfels:  # fmt: skip
    brightness = np.ones(len(ranges), np.float32)
    return build_surfels(origins, directions, ranges, brightness, voxel_m=voxel_m, joined=joined)


def _opacity() -> Reading:
    counts = [0, 1, 2, 7, 1000, 999_999, 1_000_000]
    hits, passes = (np.array(a, np.int32).ravel() for a in np.meshgrid(counts, counts))
    found = replace(_surfels(*_wall()), hits=hits, passes=passes).opacity
    assert bool(((found > 0.0) & (found < 1.0)).all()), "certainty"
    both = zip(hits.tolist(), passes.tolist(), strict=True)
    exact = np.array([float((h + Fraction(1, 10)) / (h + p + Fraction(1, 5))) for h, p in both])
    return Reading(error=largest(found / exact, 1.0) / EPS, outcome=f"0 observations: {found[0]}")


def _logit() -> float:
    origins, directions, ranges = _wall()
    surfels, worst = _surfels(origins, directions, ranges), 0.0
    for observed in ((0, 0), (1_000_000, 0), (0, 1_000_000), (1, 1)):
        hits, passes = (np.full(len(surfels.hits), n, np.int32) for n in observed)
        seen = replace(surfels, hits=hits, passes=passes)
        batch = surface_batch(seen, origins[:200], directions[:200], most=8, near_m=0.5, far_m=80.0)
        if len(batch.logit) == 0:
            assert observed == (0, 1_000_000), f"no surface after {observed}"
            continue  # what stops hardly any light is left out
        assert bool(batch.facts.isfinite().all()), f"facts after {observed}"
        worst = max(worst, largest(batch.logit, 0.0))
    return worst


def _million_in_a_voxel() -> Reading:
    """Mean and thickness of a flat heap of returns, of its voxel alone, against exact sums."""
    rng = np.random.default_rng(1)
    points = np.array([150.0, -130.0, 2.0]) + rng.normal(0, 1, (1_000_000, 3)) * np.array([0.02, 0.02, 1e-4])
    down = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    surfels = _surfels(points - 5.0 * down, down, np.full(len(points), 5.0), voxel_m=1.0, joined=False)
    fullest = int(surfels.hits.argmax())
    inside = points[index_points(points, 1.0)[1] == fullest]
    exact = np.array([math.fsum(inside[:, axis]) / len(inside) for axis in range(3)])
    spread = math.sqrt(math.fsum((inside[:, 2] - exact[2]) ** 2) / len(inside))
    assert abs(surfels.normal[fullest, 2]) > 0.9999, "a tilted normal"
    error = max(largest(surfels.mean_m[fullest], exact), largest(surfels.thickness_m[fullest], spread))
    return Reading(error=error, outcome=f"{len(inside)} returns")


def _identical_returns() -> float:
    ahead = np.tile([1.0, 0.0, 0.0], (1000, 1))
    surfels = _surfels(np.zeros((1000, 3)), ahead, np.full(1000, 7.0))
    assert not surfels.normal.any() and bool(np.isfinite(surfels.thickness_m).all()), "a plane"
    assert bool(np.isfinite(surfels.intensity).all() and np.isfinite(surfels.opacity).all())
    return largest(surfels.mean_m[0], np.array([7.0, 0.0, 0.0]))


def _wall_ranges() -> float:
    """Each ray's median surface against the wall; at its edges are voxels of too few returns for a plane."""
    (origins, directions, ranges), worst = _wall(100_000), 0.0
    for voxel_m in (0.1, 0.25, 0.5, 1.0, 2.0):
        surfels = _surfels(origins, directions, ranges, voxel_m)
        found = candidates_of(surfels, origins, directions, most=8, near_m=0.5, far_m=80.0)
        median = weighted_median_index(found.weights)
        off_m = np.abs(found.range_m[np.arange(len(ranges)), median] - ranges)
        worst = max(worst, float(np.quantile(off_m, 0.999)))
    return worst


def _axis_rays() -> str:
    surfels = _surfels(*_wall())
    low, step = surfels.index.origin_m, surfels.index.voxel_m
    starts = [(low + o * step, low + 20 * step, np.zeros(3), [10.0, 0.0, 0.0]) for o in (0.0, 0.5, 1.0)]
    origins = np.tile(np.concatenate(starts), (6, 1))
    directions = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 12, axis=0)
    found = candidates_of(surfels, origins, directions, most=16, near_m=0.0, far_m=100.0)
    there = found.voxel >= 0
    assert bool(np.isfinite(found.range_m).all() and np.isfinite(found.cosine).all()) and bool(there.any())
    assert all(np.all(np.diff(r[t]) >= -1e-5) for r, t in zip(found.range_m, there, strict=True)), "order"
    assert bool(((found.range_m[there] >= 0.0) & (found.range_m[there] <= 100.0)).all()), "beyond near or far"
    return f"finite, ascending, within near and far; {int(there.sum())} surfaces"


def _votes() -> str:
    """Scans of which all, none and each laser's own firing returned; a sweep of one firing."""
    fraction = ((np.arange(100) + 0.5) / 100 - 0.5).astype(np.float32)
    is_hit = np.stack([np.ones((4, 100)), np.zeros((4, 100)), np.eye(4, 100)]).astype(bool)
    prior = DropPrior(np.arange(3.0), np.tile(fraction, (3, 1)), is_hit)
    asked = np.array([-0.5, -0.6, 0.499, 0.7, float(fraction[0]), float(fraction[-1])])
    said = [prior.hit_prior(np.zeros(6, np.int64), asked, np.array([scan])).tolist() for scan in range(3)]
    assert said == [[1.0] * 6, [0.0] * 6, [1.0, 1.0, 0.0, 0.0, 1.0, 0.0]], f"{said}"
    once = np.array([[0.0, math.inf, math.inf]], np.float32)
    alone = DropPrior(np.zeros(1), once, np.array([[[True, False, False]]]))
    assert bool((alone.hit_prior(np.zeros(6, np.int64), asked, np.array([0])) == 1.0).all()), "one firing"
    return "1, 0, and the nearest end beyond the sweep"


def _points(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 1.0, (1_000_000, 3)).astype(np.float32) * np.array([25.0, 25.0, 1.5], np.float32)


def _voxels() -> Reading:
    """Every sampled point's voxel is the one that holds it, and voxels count all points."""
    points = np.concatenate([_points(seed) for seed in range(10)])
    index, voxel = index_points(points, 0.2)
    sample = np.random.default_rng(0).integers(0, len(points), 2_000)
    place = np.floor((points[sample].astype(np.float64) - index.origin_m) / index.voxel_m).astype(np.int64)
    within = place % 8 @ [64, 8, 1]
    expected = index.cells[index.bricks[tuple((place // 8).T)], within]
    assert len(voxel) == len(points) and (np.bincount(voxel) > 0).sum() == index.voxel_count, (
        "a voxel without points"
    )
    return Reading(error=float((expected != voxel[sample]).sum()), outcome=f"{index.voxel_count:,} voxels")


def _stray(name: str, *point: float) -> Case:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], point])
    return Case(_INDEX, f"{name} (outside)", refused(DataError, lambda: index_points(points, 0.25)))


_INDEX, _SURFELS = "geometry.voxels.index_points", "evidence.surfels"
CASES = (
    Case(f"{_SURFELS}.Surfels.opacity", "0 to 1e6 hits and passes", _opacity, ELEMENTWISE_ULP, "eps"),
    Case("fields.lidar_field.surface_batch", "logits after 0 and 1e6 observations", _logit, 16.2,
         "nats, at most"),
    Case(f"{_SURFELS}.build_surfels", "1e6 returns in a voxel, 200 m out", _million_in_a_voxel, 2e-5, "m"),
    Case(f"{_SURFELS}.build_surfels", "one return, a thousand times", _identical_returns, 1e-6, "m"),
    Case(f"{_SURFELS}.build_surfels", "a wall at 10 m, voxels of 0.1 to 2 m: rays' ranges",
         _wall_ranges, 1e-3, "m (99.9 % of rays)"),
    Case(f"{_SURFELS}.candidates_of", "rays along axes, borders and edges", _axis_rays),
    Case("evidence.drop_prior.DropPrior.hit_prior",
         "all, none; fractions at and beyond a sweep's ends; one firing a sweep", _votes),
    Case(_INDEX, "1e7 points at once, 0.2 m voxels", _voxels, 0.0, "of 2,000 sampled"),
    Case(_INDEX, "no point (outside)", refused(DataError, lambda: index_points(np.zeros((0, 3)), 0.25))),
    _stray("a stray point at 1e5 m", 1e5, 1e5, 1e5),
    _stray("a stray point at 1e10 m: beyond int32", 1e10, 0.0, 0.0),
    _stray("NaN", math.nan, 0.0, 0.0),
)  # fmt: skip
