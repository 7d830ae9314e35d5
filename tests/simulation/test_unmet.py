"""Which rays that meet no surface are copied: the sensor's own, in its own place, where scans returned."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.scene_evidence import ALL, MOST, NEVER, SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.recording.drive import LidarRecording, Sweeps
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E, VLP_16
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import fire_sweep, render_along
from nvsf_core.simulation.view_plan import SweepPlan

SCANS, FIRINGS, PERIOD_S = 3, 60, 0.1
LASERS = np.arange(8, 12, dtype=np.int16)
RANGES_M = np.array([30.0, 31.0, 32.0])
"""Of all returns of each scan; the second is the sweep's own instant."""


def answers_half(origin_m, direction, hit_prior, time_s) -> RenderedRays:
    """Every other ray meets something at 20 m."""
    met = np.arange(len(hit_prior)) % 2 == 0
    return RenderedRays(
        np.where(met, 20.0, np.inf).astype(np.float32), np.where(met, 0.6, 0.0).astype(np.float32),
        np.full(len(hit_prior), 0.1, np.float32),
    )  # fmt: skip


def scene() -> LidarRecording:
    """All firings of the upper two lasers always returned, of the others in the later two scans of three."""
    is_hit = np.zeros((SCANS, 64, FIRINGS), bool)
    is_hit[:, LASERS] = True
    is_hit[0, LASERS[2:]] = False
    fraction = np.tile((np.arange(FIRINGS, dtype=np.float32) + 0.5) / FIRINGS - 0.5, (SCANS, 1))
    path = Trajectory(np.arange(SCANS) * PERIOD_S, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4))
    place = np.array([[1.0, 0.0, 0.0]], np.float32)
    surfels = build_surfels(0 * place, place, np.full(1, 90.0), np.ones(1), voxel_m=0.2)
    own = np.zeros((64, 4), np.float32)
    prior = DropPrior(path.times_s, fraction, is_hit)
    evidence = SceneEvidence(surfels, prior, LASERS, np.full(SCANS, FIRINGS), own, own)
    scan, laser, firing = np.nonzero(is_hit)
    arrays = {
        "offsets": np.concatenate([[0], np.cumsum(np.bincount(scan, minlength=SCANS))]),
        "laser": laser, "firing": firing, "sweep_fraction": fraction[0][firing],
        "firings": np.full(SCANS, FIRINGS), "range_m": RANGES_M[scan], "intensity": RANGES_M[scan] / 100.0,
    }  # fmt: skip
    sweeps = Sweeps(
        arrays=arrays, is_training=np.ones(SCANS, bool), trajectory=path, period_s=PERIOD_S, table=HDL_64E,
        elevation_correction_rad=0.0,
    )  # fmt: skip
    return LidarRecording(sweeps=sweeps, evidence=evidence)


def fire(plan: SweepPlan, *, copied_share: float = ALL, copies_unmet: bool = True) -> RenderedRays:
    lidar = scene()
    lidar = replace(lidar, evidence=replace(lidar.evidence, copied_share=copied_share))
    model = SceneModel(lidar=answers_half, camera=None, copies_unmet=copies_unmet, prior_scans=SCANS)
    return fire_sweep(model, lidar, plan, PERIOD_S)[1]


IN_PLACE = SweepPlan("x", np.zeros(1, np.int64), np.array([PERIOD_S]), None, HDL_64E, True)
UPPER = np.repeat([True, True, False, False], FIRINGS)


@pytest.mark.parametrize(
    ("copied_share", "are_copied"),
    [(ALL, UPPER), (MOST, np.full(4 * FIRINGS, True)), (NEVER, np.full(4 * FIRINGS, False))],
    ids=["all", "most", "never"],
)
def test_a_ray_that_meets_nothing_is_copied_where_enough_scans_returned_and_no_other(
    copied_share: float, are_copied: np.ndarray
) -> None:
    before, after = fire(IN_PLACE, copies_unmet=False), fire(IN_PLACE, copied_share=copied_share)
    unmet = ~np.isfinite(before.range_m)
    copied = unmet & are_copied
    assert unmet.sum() == 2 * FIRINGS
    assert (after.range_m[copied] == 31.0).all(), "the scan nearest in time returned, too"
    assert np.allclose(after.intensity[copied], 0.31)
    assert np.allclose(after.hit[copied], np.where(UPPER, 1.0, 2.0 / 3.0)[copied])
    for name in ("range_m", "hit", "intensity"):
        assert np.array_equal(getattr(after, name)[~copied], getattr(before, name)[~copied])


def test_where_the_nearest_scan_had_no_return_the_next_one_is_copied() -> None:
    lidar = scene()
    is_hit = lidar.evidence.prior.is_hit.copy()
    arrays = dict(lidar.sweeps.arrays)
    kept = (np.repeat(np.arange(SCANS), np.diff(arrays["offsets"])) != 1) | (arrays["laser"] != LASERS[0])
    is_hit[1, LASERS[0]] = False
    arrays |= {
        name: arrays[name][kept] for name in ("laser", "firing", "sweep_fraction", "range_m", "intensity")
    }
    arrays["offsets"] = np.array([0, *np.cumsum(is_hit.sum(axis=(1, 2)))])
    evidence = replace(lidar.evidence, prior=replace(lidar.evidence.prior, is_hit=is_hit), copied_share=MOST)
    moved = LidarRecording(sweeps=replace(lidar.sweeps, arrays=arrays), evidence=evidence)
    model = SceneModel(lidar=answers_half, camera=None, copies_unmet=True, prior_scans=SCANS)
    range_m = fire_sweep(model, moved, IN_PLACE, PERIOD_S)[1].range_m.reshape(4, FIRINGS)
    assert set(range_m[0]) == {20.0, 30.0}, "of two scans equally near the earlier one"
    assert set(range_m[1]) == {20.0, 31.0}


@pytest.mark.parametrize(
    "plan",
    [
        replace(IN_PLACE, mount=np.array([[1.0, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])),
        replace(IN_PLACE, table=VLP_16, is_recorded_sensor=False),
    ],
    ids=["elsewhere", "another sensor"],
)
def test_scans_tell_nothing_of_another_place_or_sensor(plan: SweepPlan) -> None:
    before, after = fire(plan, copies_unmet=False), fire(plan, copied_share=MOST)
    assert (~np.isfinite(before.range_m)).any()
    assert np.array_equal(after.range_m, before.range_m)


def test_single_rays_are_copied_too_unless_their_laser_is_unknown() -> None:
    lidar = scene()
    model = SceneModel(lidar=answers_half, camera=None, copies_unmet=True, prior_scans=SCANS)
    place, ahead = np.zeros((4, 3), np.float32), np.tile(np.array([1.0, 0, 0], np.float32), (4, 1))
    laser, fraction = np.array([8, 8, -1, -1]), np.zeros(4)
    found = render_along(model, lidar, PERIOD_S, place, ahead, laser, fraction)
    assert found.range_m.tolist() == [20.0, 31.0, 20.0, np.inf]


@pytest.mark.parametrize("is_recorded_sensor", [True, False])
def test_a_sweep_of_the_recording_sensor_has_the_phase_of_its_scans(is_recorded_sensor: bool) -> None:
    recorded = scene()
    evidence = recorded.evidence
    quarter = evidence.prior.fraction - np.float32(0.25 / FIRINGS)
    prior = replace(evidence.prior, fraction=quarter)
    moved = LidarRecording(sweeps=recorded.sweeps, evidence=replace(evidence, prior=prior))
    plan = replace(IN_PLACE, is_recorded_sensor=is_recorded_sensor)
    model = SceneModel(lidar=answers_half, camera=None, prior_scans=SCANS)
    rays, _ = fire_sweep(model, moved, plan, PERIOD_S)
    count = rays.shape[1]
    steps = (rays.fraction[:count] + 0.5) * count - np.arange(count)
    assert steps == pytest.approx(0.25 if is_recorded_sensor else 0.5, abs=1e-3)
