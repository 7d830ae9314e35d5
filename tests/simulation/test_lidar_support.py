"""Laws of support: what recorded scans agree on is seen, what none recorded is guessed."""

from dataclasses import replace

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.recording.drive import LidarRecording, ScanLookups, Sweeps
from nvsf_core.rendering.rendered import RenderedRays, Support
from nvsf_core.sensors.sweep import SweepRays, Trajectory, sweep_rays
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.sweep_simulation import support_of_sweep

SCANS, FIRINGS, PERIOD_S, WALL_M = 3, 200, 0.1, 10.0
LASERS = np.arange(10, 20)
NEAR = np.arange(SCANS)


def standing(mount: np.ndarray | None = None) -> tuple[Trajectory, SweepRays]:
    path = Trajectory(np.arange(SCANS) * PERIOD_S, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    return path, sweep_rays(HDL_64E, LASERS, FIRINGS, path, PERIOD_S, PERIOD_S, mount=mount)


def recorded(is_hit: np.ndarray) -> LidarRecording:
    """Three scans of a round wall 10 m away, of which each (3, 64, f) firing returned or not."""
    path, rays = standing()
    fraction = np.tile(rays.fraction[:FIRINGS].astype(np.float32), (SCANS, 1))
    scan, laser, firing = np.nonzero(is_hit)
    arrays = {
        "offsets": np.concatenate([[0], np.cumsum(np.bincount(scan, minlength=SCANS))]),
        "laser": laser, "firing": firing, "sweep_fraction": fraction[0][firing],
        "firings": np.full(SCANS, FIRINGS), "range_m": np.full(len(scan), WALL_M),
        "intensity": np.ones(len(scan)),
    }  # fmt: skip
    sweeps = Sweeps(
        arrays=arrays, is_training=np.ones(SCANS, bool), trajectory=path, period_s=PERIOD_S, table=HDL_64E,
        elevation_correction_rad=HDL_64E.elevation_correction_rad,
    )  # fmt: skip
    count = len(rays.laser)
    surfels = build_surfels(
        rays.origin_m, rays.direction, np.full(count, WALL_M, np.float32), np.ones(count), voxel_m=0.2
    )
    own = np.zeros((64, 4), np.float32)
    prior = DropPrior(path.times_s, fraction, is_hit)
    evidence = SceneEvidence(surfels, prior, LASERS.astype(np.int16), np.full(SCANS, FIRINGS), own, own)
    return LidarRecording(sweeps=sweeps, evidence=evidence)


def all_hit() -> np.ndarray:
    is_hit = np.zeros((SCANS, 64, FIRINGS), bool)
    is_hit[:, LASERS] = True
    return is_hit


def shown(rays: SweepRays, range_m: float, hit: float = 1.0) -> RenderedRays:
    count = len(rays.laser)
    return RenderedRays(
        np.full(count, range_m, np.float32), np.full(count, hit, np.float32), np.ones(count, np.float32)
    )


def support(lidar: LidarRecording, rendered: RenderedRays, rays: SweepRays) -> np.ndarray:
    at_s = np.full(len(rays.laser), PERIOD_S)
    lookups = ScanLookups(lidar.scan_grids, NEAR, gaps_hide=True)
    return support_of_sweep(lidar, rays, rendered, at_s, lookups, is_own_unit=False)


def test_what_the_scans_agree_on_is_seen() -> None:
    _, rays = standing()
    assert (support(recorded(all_hit()), shown(rays, WALL_M), rays) == Support.SEEN).all()


def test_what_one_scan_denies_is_extrapolated() -> None:
    is_hit, (_, rays) = all_hit(), standing()
    is_hit[1, 12] = False
    found = support(recorded(is_hit), shown(rays, WALL_M), rays).reshape(len(LASERS), FIRINGS)
    assert (found[2] == Support.EXTRAPOLATED).all()
    assert (np.delete(found, 2, axis=0) == Support.SEEN).all()


def test_a_drop_that_the_scans_agree_on_is_seen() -> None:
    is_hit, (_, rays) = all_hit(), standing()
    is_hit[:, 12] = False
    found = support(recorded(is_hit), shown(rays, WALL_M, hit=0.1), rays).reshape(len(LASERS), FIRINGS)
    assert (found[2] == Support.SEEN).all()
    assert (np.delete(found, 2, axis=0) == Support.EXTRAPOLATED).all()


def test_a_wall_seen_from_elsewhere_is_extrapolated() -> None:
    mount = np.eye(4)
    mount[0, 3] = 8.0  # two metres before the wall ahead
    _, rays = standing(mount)
    reach = np.einsum("ni,ni->n", rays.origin_m, rays.direction)
    inside = reach**2 - np.einsum("ni,ni->n", rays.origin_m, rays.origin_m) + WALL_M**2
    range_m = (np.sqrt(inside) - reach).astype(np.float32)
    found = support(recorded(all_hit()), replace(shown(rays, 1.0), range_m=range_m), rays)
    is_close = range_m < 4.0
    assert is_close.any()
    assert (found[is_close] != Support.SEEN).all()


def test_where_nothing_was_recorded_is_guessed() -> None:
    _, rays = standing()
    assert (support(recorded(all_hit()), shown(rays, 4.0), rays) == Support.GUESSED).all()


def test_of_rays_without_an_end_those_are_guessed_where_no_scan_looked() -> None:
    _, rays = standing()
    nothing = shown(rays, np.inf, hit=0.0)
    is_hit = all_hit()
    is_hit[:, 12] = False
    found = support(recorded(is_hit), nothing, rays).reshape(len(LASERS), FIRINGS)
    assert (found[2] == Support.SEEN).all()
    assert (found[5] == Support.EXTRAPOLATED).all(), "the scans had returns there"
    up = np.eye(4)
    up[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    _, turned = standing(up)
    away = support(recorded(all_hit()), shown(turned, np.inf, hit=0.0), turned)
    assert (away == Support.GUESSED).any()


def test_without_a_neighbour_one_scan_is_enough() -> None:
    _, rays = standing()
    at_s = np.full(len(rays.laser), PERIOD_S)
    lidar = recorded(all_hit())
    one = ScanLookups(lidar.scan_grids, NEAR[:1], gaps_hide=True)
    alone = support_of_sweep(lidar, rays, shown(rays, WALL_M), at_s, one, is_own_unit=False)
    assert (alone == Support.SEEN).all()
