"""A sensor of one's own has no return from beyond its greatest range, whatever renders it."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.drives.view_parts import SensorEntry
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.tables import LaserTable
from nvsf_core.simulation.scan import sample_scan
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import fire_sweep, simulate_sweep
from nvsf_core.simulation.view_plan import SweepPlan
from tests.simulation.test_unmet import IN_PLACE, PERIOD_S, SCANS, answers_half, scene

FAR_M, ABOVE_M = 20.0, 50.0
"""Where every other ray ends, and those above the recorded lasers of which the LiDAR knows nothing."""


def _above(origin_m, direction, hit_prior, time_s) -> RenderedRays:
    """Images show something wherever they are asked."""
    columns = (np.full(len(hit_prior), value, np.float32) for value in (ABOVE_M, 0.9, 0.3))
    return RenderedRays(*columns)


MODEL = SceneModel(lidar=answers_half, camera=None, above=_above, prior_scans=SCANS)


def _plan(max_range_m: float) -> SweepPlan:
    entry = SensorEntry(
        name="mine", elevation_deg=(30.0, -10.0), azimuth_step_deg=4.0, max_range_m=max_range_m
    )
    return replace(IN_PLACE, table=entry.table(), is_recorded_sensor=False)


@pytest.mark.parametrize(
    ("max_range_m", "seen_m"), [(60.0, {FAR_M, ABOVE_M}), (30.0, {FAR_M}), (10.0, set())]
)
def test_nothing_returns_from_beyond_it(max_range_m: float, seen_m: set[float]) -> None:
    rendered = fire_sweep(MODEL, scene(), _plan(max_range_m), PERIOD_S)[1]
    known = np.isfinite(rendered.range_m)
    assert set(rendered.range_m[known].tolist()) == seen_m
    assert (rendered.hit[~known] == 0.0).all()
    swept = simulate_sweep(MODEL, scene(), _plan(max_range_m), PERIOD_S)
    points_m, _ = sample_scan(swept.grid, np.random.default_rng(1), range_noise_m=0.0)
    for found_m in (swept.points_m, points_m[:, :3]):
        assert (np.linalg.norm(found_m, axis=1) <= max_range_m).all()
    assert len(points_m) > 0 or not seen_m


def test_what_is_nearer_stays_as_it_is() -> None:
    far, near = (fire_sweep(MODEL, scene(), _plan(one), PERIOD_S)[1] for one in (60.0, 30.0))
    within = np.isfinite(near.range_m)
    for name in ("range_m", "hit", "intensity"):
        assert np.array_equal(getattr(far, name)[within], getattr(near, name)[within])


def test_the_recording_sensor_s_own_returns_are_left_alone() -> None:
    short: LaserTable = replace(IN_PLACE.table, max_range_m=10.0)
    own = replace(MODEL, above=None)
    usual, cut = (
        fire_sweep(own, scene(), replace(IN_PLACE, table=table), PERIOD_S)[1]
        for table in (IN_PLACE.table, short)
    )
    assert np.array_equal(usual.range_m, cut.range_m) and np.array_equal(usual.hit, cut.hit)
