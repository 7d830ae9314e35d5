"""Who is asked about unknown space: rays of the sensor in its own place, all of whose voters returned."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import build_surfels
from nvsf_core.recording.drive import LidarRecording, Sweeps
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E, VLP_16
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import ask_unobserved, fire_sweep
from nvsf_core.simulation.view_plan import SweepPlan

SCANS, FIRINGS, PERIOD_S = 3, 60, 0.1
LASERS = np.arange(8, 12, dtype=np.int16)


def of_unknown(asked: list[int]):
    """A renderer that notes how many rays it is asked about and puts all of them 7 m away."""

    def answer(origin_m, direction, hit_prior, time_s) -> RenderedRays:
        asked.append(len(hit_prior))
        return RenderedRays(
            np.full(len(hit_prior), 7.0, np.float32), hit_prior, np.full(len(hit_prior), 0.5, np.float32)
        )

    return answer


def answers_half(origin_m, direction, hit_prior, time_s) -> RenderedRays:
    """Every other ray meets something at 20 m."""
    met = np.arange(len(hit_prior)) % 2 == 0
    return RenderedRays(
        np.where(met, 20.0, np.inf).astype(np.float32), np.where(met, 0.6, 0.0).astype(np.float32),
        np.full(len(hit_prior), 0.1, np.float32),
    )  # fmt: skip


def scene() -> LidarRecording:
    """All firings of the upper two lasers always returned, of the others in two scans of three."""
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
        "firings": np.full(SCANS, FIRINGS), "range_m": np.full(len(scan), 90.0),
        "intensity": np.ones(len(scan)),
    }  # fmt: skip
    sweeps = Sweeps(
        arrays=arrays, is_training=np.ones(SCANS, bool), trajectory=path, period_s=PERIOD_S, table=HDL_64E,
        elevation_correction_rad=0.0,
    )  # fmt: skip
    return LidarRecording(sweeps=sweeps, evidence=evidence)


def fire(plan: SweepPlan, unobserved) -> RenderedRays:
    model = SceneModel(lidar=answers_half, camera=None, unobserved=unobserved, prior_scans=SCANS)
    return fire_sweep(model, scene(), plan, PERIOD_S)[1]


IN_PLACE = SweepPlan("x", np.zeros(1, np.int64), np.array([PERIOD_S]), None, HDL_64E, True)


def test_what_met_nothing_though_all_scans_returned_is_answered_and_nothing_else() -> None:
    asked: list[int] = []
    before, after = fire(IN_PLACE, None), fire(IN_PLACE, of_unknown(asked))
    upper = np.repeat([True, True, False, False], FIRINGS)
    open_rays = upper & ~np.isfinite(before.range_m)
    assert asked == [FIRINGS] and open_rays.sum() == FIRINGS
    assert (after.range_m[open_rays] == 7.0).all() and (after.hit[open_rays] == 1.0).all()
    for name in ("range_m", "hit", "intensity"):
        assert np.array_equal(getattr(after, name)[~open_rays], getattr(before, name)[~open_rays])
    assert not np.isfinite(after.range_m[~upper]).all(), "one scan of three had no return there"


@pytest.mark.parametrize(
    "plan",
    [
        replace(IN_PLACE, mount=np.array([[1.0, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])),
        replace(IN_PLACE, table=VLP_16, is_recorded_sensor=False),
    ],
    ids=["elsewhere", "another sensor"],
)
def test_scans_tell_nothing_of_another_place_or_sensor(plan: SweepPlan) -> None:
    asked: list[int] = []
    fire(plan, of_unknown(asked))
    assert asked == []


def test_its_intensity_has_the_laser_s_gain_and_answers_stay_as_they_were() -> None:
    gain = np.ones(64)
    gain[9] = 1.5
    table = replace(HDL_64E, intensity_gain=gain)
    nothing = RenderedRays(np.full(2, np.inf, np.float32), np.zeros(2, np.float32), np.zeros(2, np.float32))
    place, sure = np.zeros((2, 3), np.float32), np.ones(2, np.float32)
    found = ask_unobserved(nothing, of_unknown([]), place, place, sure, np.zeros(2), np.array([9, -1]), table)
    assert np.allclose(found.intensity, [0.75, 0.5]) and (found.range_m == 7.0).all()
    assert np.isinf(nothing.range_m).all(), "others may hold them"
    unsure = np.full(2, 5.0 / 6.0, np.float32)
    same = ask_unobserved(
        nothing, of_unknown([]), place, place, unsure, np.zeros(2), np.array([9, -1]), table
    )
    assert same is nothing


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
