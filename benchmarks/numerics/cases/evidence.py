"""Evidence: how sure it is after nothing and after a million observations, and where rays are degenerate."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Reading, refused
from benchmarks.numerics.cases.tolerances import TOLERANCES
from nvsf_core.errors import DataError
from nvsf_core.evidence.raydrop.prior import DropPrior
from nvsf_core.evidence.static.surfels import Surfels, build_surfels, candidates_of
from nvsf_core.evidence.static.voxels import index_points
from nvsf_core.fields.surface_batch import surface_batch
from nvsf_core.rendering.weights import value_at, weighted_median_index

TITLE = "Evidence"
_EPS = float(np.finfo(np.float32).eps)


def wall(
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0), *, rays: int = 4000
) -> tuple[np.ndarray, ...]:
    """Rays from around a place to a wall ahead (plane x = 10.03): origins, directions, ranges, intensity."""
    rng = np.random.default_rng(0)
    origins = rng.normal(0.0, 0.5, (rays, 3))
    targets = np.stack([np.full(rays, 10.03), rng.uniform(-4, 4, rays), rng.uniform(-2, 2, rays)], axis=1)
    ray = targets - origins
    ranges = np.linalg.norm(ray, axis=1)
    return origins + np.array(origin_m), ray / ranges[:, None], ranges, rng.random(rays).astype(np.float32)


def _surfels(voxel_m: float = 0.25) -> Surfels:
    return build_surfels(*wall(), voxel_m=voxel_m, threads=1)


def _opacity() -> Reading:
    """Hit shares for counts of 0 to 1e6 on both sides, against exact fractions."""
    counts = [0, 1, 2, 7, 1000, 999_999, 1_000_000]
    hits, passes = (np.array(a, np.int32).ravel() for a in np.meshgrid(counts, counts))
    found = replace(_surfels(), hits=hits, passes=passes).opacity
    exact = [float((h + Fraction(1, 10)) / (h + p + Fraction(1, 5)))
             for h, p in zip(hits.tolist(), passes.tolist(), strict=True)]  # fmt: skip
    error = float((np.abs(found - exact) / np.array(exact)).max()) / _EPS
    inside = bool(((found > 0.0) & (found < 1.0)).all())
    return Reading(
        error=error, limit=TOLERANCES[torch.float32].elementwise_ulp, unit="eps",
        float32="ok", is_refuted=not inside,
        outcome=f"0 observations: {found[(hits == 0) & (passes == 0)][0]}; between 0 and 1: {inside}",
    )  # fmt: skip


def _logit() -> Reading:
    """The logit that the field starts from stays finite and keeps its sign, whatever was observed."""
    surfels = _surfels()
    count = len(surfels.hits)
    origins, directions, _, _ = wall()
    worst = 0.0
    for hits, passes in ((0, 0), (1_000_000, 0), (0, 1_000_000), (1, 1)):
        changed = replace(
            surfels, hits=np.full(count, hits, np.int32), passes=np.full(count, passes, np.int32)
        )
        batch = surface_batch(changed, origins[:200], directions[:200], most=8, near_m=0.5, far_m=80.0)
        if not bool(batch.logit.isfinite().all()) or not bool(batch.facts.isfinite().all()):
            worst = math.inf
        worst = max(worst, float(batch.logit.abs().max()))
    return Reading(error=worst, limit=16.2, unit="nats, at most", float32="ok")


def _million_in_a_voxel() -> Reading:
    """Mean and thickness of 1e6 returns in one voxel, 200 m from the origin, against exact sums."""
    rng = np.random.default_rng(1)
    points = np.array([150.0, -130.0, 2.0]) + rng.normal(0, 1, (1_000_000, 3)) * np.array([0.02, 0.02, 1e-4])
    origins = points - np.array([0.0, 0.0, 5.0])
    ranges, directions = np.full(len(points), 5.0), np.tile([0.0, 0.0, 1.0], (len(points), 1))
    surfels = build_surfels(
        origins, directions, ranges, np.ones(len(points), np.float32), voxel_m=1.0, threads=1
    )
    main = int(surfels.hits.argmax())
    index, voxel = index_points(points, 1.0)
    inside = points[voxel == main]
    exact = np.array([math.fsum(inside[:, axis]) / len(inside) for axis in range(3)])
    spread = math.sqrt(math.fsum((inside[:, 2] - exact[2]) ** 2) / len(inside))
    error = float(np.abs(surfels.mean_m[main] - exact).max())
    thickness = float(abs(surfels.thickness_m[main] - spread))
    return Reading(
        error=max(error, thickness), limit=2e-5, unit="m",
        outcome=f"{len(inside)} returns; normal z {abs(surfels.normal[main, 2]):.6f}; "
        f"{index.voxel_count} voxels",
        is_refuted=not abs(surfels.normal[main, 2]) > 0.9999,
    )  # fmt: skip


def _identical_returns() -> Reading:
    """The same return a thousand times: no plane, no thickness, no NaN."""
    origins, directions = np.zeros((1000, 3)), np.tile([1.0, 0.0, 0.0], (1000, 1))
    surfels = build_surfels(
        origins, directions, np.full(1000, 7.0), np.zeros(1000, np.float32), voxel_m=0.25, threads=1
    )
    arrays = (surfels.mean_m, surfels.normal, surfels.thickness_m, surfels.intensity, surfels.opacity)
    finite = all(bool(np.isfinite(a).all()) for a in arrays)
    error = float(np.abs(surfels.mean_m[0] - [7.0, 0.0, 0.0]).max())
    return Reading(
        error=error, limit=1e-6, unit="m", is_refuted=not finite or bool(surfels.normal.any()),
        outcome=f"finite: {finite}; thickness {float(surfels.thickness_m[0])} m",
    )  # fmt: skip


def _axis_rays() -> Reading:
    """Rays exactly along axes, along voxel borders and edges, from outside, from within, away from all."""
    surfels = _surfels()
    step = surfels.index.voxel_m
    low = surfels.index.origin_m
    origins, directions = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            direction = np.zeros(3)
            direction[axis] = sign
            for offset in (0.0, 0.5, 1.0):
                origins += [low + offset * step, low + 20 * step, np.zeros(3), np.array([10.0, 0.0, 0.0])]
                directions += [direction] * 4
    found = candidates_of(surfels, np.array(origins), np.array(directions), most=16, near_m=0.0, far_m=100.0)
    there = found.voxel >= 0
    finite = bool(np.isfinite(found.range_m).all()) and bool(np.isfinite(found.cosine).all())
    ordered = all(np.all(np.diff(r[t]) >= -1e-5) for r, t in zip(found.range_m, there, strict=True))
    inside = bool((found.range_m[there] >= 0.0).all()) and bool((found.range_m[there] <= 100.0).all())
    outcome = (
        f"finite {finite}, ascending {ordered}, within near and far {inside}; {int(there.sum())} surfaces"
    )
    return Reading(outcome=outcome, is_refuted=not (finite and ordered and inside and there.any()))


def _median_on_the_wall() -> Reading:
    """First surfaces against the wall's own equation, at 0.1 to 2 m voxels."""
    origins, directions, ranges, _ = wall()
    worst = 0.0
    for voxel_m in (0.1, 0.25, 2.0):
        surfels = _surfels(voxel_m)
        found = candidates_of(surfels, origins, directions, most=8, near_m=0.5, far_m=80.0)
        passed = np.cumprod(np.pad(1.0 - found.opacity, ((0, 0), (1, 0)), constant_values=1.0), axis=1)
        weights = torch.from_numpy(passed[:, :-1] * found.opacity)
        median_m = value_at(torch.from_numpy(found.range_m), weighted_median_index(weights)).numpy()
        # A voxel of fewer than five returns has no plane yet.
        planar = (surfels.is_planar[found.voxel] | (found.voxel < 0)).all(axis=1) & (found.voxel[:, 0] >= 0)
        worst = max(worst, float(np.quantile(np.abs(median_m - ranges)[planar], 0.999)))
    return Reading(error=worst, limit=1e-3, unit="m (99.9 % of rays)", outcome="median surface, float32")


def _votes() -> Reading:
    """Votes of scans that all, or none, returned; fractions on both ends of a turn and beyond."""
    fraction = ((np.arange(100) + 0.5) / 100 - 0.5).astype(np.float32)
    is_hit = np.stack([np.ones((4, 100)), np.zeros((4, 100)), np.eye(4, 100)]).astype(bool)
    prior = DropPrior(np.arange(3.0), np.tile(fraction, (3, 1)), is_hit)
    asked = np.array([-0.5, -0.6, 0.499, 0.7, float(fraction[0]), float(fraction[-1])])
    laser = np.zeros(len(asked), np.int64)
    all_in, none_in = (
        prior.hit_prior(laser, asked, np.array([0])),
        prior.hit_prior(laser, asked, np.array([1])),
    )
    ends = prior.hit_prior(laser, asked, np.array([2]))
    sound = bool((all_in == 1).all()) and bool((none_in == 0).all())
    sound &= ends.tolist() == [1.0, 1.0, 0.0, 0.0, 1.0, 0.0]
    return Reading(outcome="1, 0, and the nearest end beyond the turn", is_refuted=not sound)


def _one_firing() -> Reading:
    """A turn of one firing answers for the whole turn."""
    fraction = np.array([[0.0, math.inf, math.inf]], np.float32)
    prior = DropPrior(np.zeros(1), fraction, np.array([[[True, False, False]]]))
    found = prior.hit_prior(np.zeros(3, np.int64), np.array([-0.4, 0.0, 0.4]), np.array([0]))
    return Reading(outcome=f"votes {found.tolist()}", is_refuted=found.tolist() != [1.0, 1.0, 1.0])


def _stray(points: np.ndarray) -> Reading:
    return refused(DataError, lambda: index_points(points, 0.25))


_TWO = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
CASES = (
    Case("evidence.static.surfels.Surfels.opacity", "0 to 1e6 hits and passes", _opacity),
    Case("fields.surface_batch.surface_batch", "logits after 0 and 1e6 observations", _logit),
    Case("evidence.static.surfels.build_surfels", "1e6 returns in a voxel, 200 m out", _million_in_a_voxel),
    Case("evidence.static.surfels.build_surfels", "one return, a thousand times", _identical_returns),
    Case("evidence.static.surfels.candidates_of", "rays along axes, borders and edges", _axis_rays),
    Case(
        "evidence.static.surfels.candidates_of", "a wall at 10 m, voxels of 0.1 to 2 m",
        _median_on_the_wall,
    ),
    Case(
        "evidence.raydrop.prior.DropPrior.hit_prior", "all, none; fractions at and beyond a turn's ends",
        _votes,
    ),
    Case("evidence.raydrop.prior.DropPrior.hit_prior", "one firing a turn", _one_firing),
    Case(
        "evidence.static.voxels.index_points", "no point (outside)", lambda: _stray(np.zeros((0, 3))),
    ),
    Case(
        "evidence.static.voxels.index_points", "a stray point at 1e5 m (outside)",
        lambda: _stray(np.concatenate([_TWO, [[1e5, 1e5, 1e5]]])),
    ),
    Case(
        "evidence.static.voxels.index_points", "a stray point at 1e10 m: beyond int32 (outside)",
        lambda: _stray(np.concatenate([_TWO, [[1e10, 0.0, 0.0]]])),
    ),
    Case(
        "evidence.static.voxels.index_points", "NaN (outside)",
        lambda: _stray(np.concatenate([_TWO, [[math.nan, 0.0, 0.0]]])),
    ),
)  # fmt: skip
