"""Laws of looking up what recorded scans had at a place."""

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.recording.drive import RecordedSweeps, ScanLookups, ray_ends_m
from nvsf_core.sensors.sweep import SweepRays, Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E

LASERS, FIRINGS, SCANS, PERIOD_S, WALL_M = np.arange(64), 400, 2, 0.1, 10.0
NEAR = np.arange(SCANS)


def recorded(range_m: np.ndarray, unit_gaps: np.ndarray | None = None) -> tuple[RecordedSweeps, SweepRays]:
    """Two scans from one place with ranges (2, 64, 400), and the rays that they were fired along."""
    path = Trajectory(np.arange(SCANS) * PERIOD_S, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    rays = sweep_rays(HDL_64E, LASERS, FIRINGS, path, PERIOD_S, PERIOD_S)
    fraction = np.tile(rays.fraction[:FIRINGS].astype(np.float32), (SCANS, 1))
    grids = RecordedSweeps(
        DropPrior(path.times_s, fraction, range_m > 0.0), LASERS, range_m, np.ones_like(range_m), path,
        HDL_64E, PERIOD_S, HDL_64E.elevation_correction_rad, unit_gaps,
    )  # fmt: skip
    return grids, rays


def wall(rays: SweepRays) -> np.ndarray:
    return (rays.origin_m + rays.direction * WALL_M).astype(np.float32)


def test_a_place_has_the_share_of_the_scans_that_returned_there() -> None:
    range_m = np.full((SCANS, 64, FIRINGS), WALL_M, np.float32)
    range_m[1, 20:30] = 0.0
    grids, rays = recorded(range_m)
    share = grids.hit_prior_at(wall(rays), NEAR).reshape(64, FIRINGS)
    assert (share[20:30] == 0.5).all()
    assert (np.delete(share, np.arange(20, 30), axis=0) == 1.0).all()


def test_what_was_hidden_is_not_missing() -> None:
    range_m = np.full((SCANS, 64, FIRINGS), WALL_M, np.float32)
    range_m[0] = 4.0  # something stood before the wall
    range_m[1, :32] = 0.0
    grids, rays = recorded(range_m)
    share = grids.hit_prior_at(wall(rays), NEAR).reshape(64, FIRINGS)
    assert not share[:32].any()
    assert (share[32:] == 1.0).all()


def test_a_gap_of_the_unit_tells_nothing() -> None:
    range_m = np.full((SCANS, 64, FIRINGS), WALL_M, np.float32)
    range_m[:, 20, 100:150] = 0.0
    gaps = np.zeros((64, FIRINGS), bool)
    gaps[20, 100:150] = True
    blind, rays = recorded(range_m)
    aware, _ = recorded(range_m, gaps)
    share = blind.hit_prior_at(wall(rays), NEAR).reshape(64, FIRINGS)
    assert np.array_equal(share < 0.5, gaps)
    assert share[20, 99:102].tolist() == [0.75, 0.25, 0.0], "firings beside count half"
    assert (aware.hit_prior_at(wall(rays), NEAR) == 1.0).all()


def test_a_ray_without_an_end_keeps_a_prior_of_one() -> None:
    range_m = np.zeros((SCANS, 64, FIRINGS), np.float32)
    grids, _ = recorded(range_m)
    nowhere = np.full((3, 3), np.inf, np.float32)
    assert grids.hit_prior_at(nowhere, NEAR).tolist() == [1.0, 1.0, 1.0]


def test_ends_that_changed_are_looked_up_again() -> None:
    rng = np.random.default_rng(0)
    grids, rays = recorded(rng.uniform(5.0, 20.0, (SCANS, 64, FIRINGS)).astype(np.float32))
    range_m = rng.uniform(5.0, 20.0, len(rays.laser)).astype(np.float32)
    range_m[:500] = np.inf
    other_m = np.where(np.arange(len(range_m)) % 7 == 0, 9.0, range_m)
    lookups = ScanLookups(grids, NEAR)
    for one_m in (range_m, other_m, other_m):
        ends_m = ray_ends_m(rays, one_m)
        assert np.isfinite(ends_m).all()
        fresh = [grids.look(ends_m, scan, gaps_hide=False) for scan in NEAR.tolist()]
        assert np.array_equal(lookups.at(ends_m), np.stack(fresh))
    assert np.array_equal(lookups.at(ends_m[:9]), np.stack(fresh)[:, :9]), "fewer rays are looked up anew"
