"""A drive of a sensor that is cut in front, that spins the other way or begins anywhere is as good as any."""

from collections.abc import Callable

import numpy as np
import pytest

from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.simulation.ray_renderers import reprojecting_renderer
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import fire_sweep
from nvsf_core.simulation.view_plan import recorded_sweep
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.inputs import read_recording
from tests.stages.clocked_drive import write_clocked_drive

FRAMES, TEST, LASERS = 9, (4,), np.arange(0, 64, 4)
CLOCKS: dict[str, Callable[[int], SweepClock]] = {
    "behind": lambda frame: SweepClock(),
    "in front": lambda frame: SweepClock(cut=0.0, lag=-0.5),
    "counter-clockwise": lambda frame: SweepClock(spin=-1.0),
    "anywhere": lambda frame: SweepClock(cut=(0.13 * frame) % 1.0 - 0.5, lag=-((0.13 * frame) % 1.0)),
}


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[float, float]]:
    """Of a drive: the shares of a held-out scan's rays whose answer, and whose surface, is right."""

    def measured(name: str) -> tuple[float, float]:
        folder = tmp_path_factory.mktemp("clock")
        scene = write_clocked_drive(
            folder / "drive", CLOCKS[name], frames=FRAMES, test=TEST, lasers=LASERS, firings=500
        )
        run = plan_run(scene, folder / "home", recipe="smoke")
        for stage in ("frames", "sweeps", "undistorted", "pano", "evidence"):
            outcome = run_named_stage(stage, run, lambda line: None)
            assert all(check.passed for check in outcome.checks if check.name == "times_follow_the_azimuth")
        return _right(run.store)

    return measured


def _right(store) -> tuple[float, float]:
    lidar = read_recording(store).lidar
    assert lidar is not None
    sweeps = lidar.sweeps
    (scan,) = np.flatnonzero(~sweeps.is_training)
    time_s = float(sweeps.arrays["time_s"][scan])
    model = SceneModel(lidar=reprojecting_renderer(lidar), camera=None)
    rays, rendered = fire_sweep(model, lidar, recorded_sweep(sweeps.table, time_s), time_s)
    part = sweeps.returns_of(int(scan))
    true_m = np.full((64, rays.shape[1]), np.inf)
    true_m[sweeps.arrays["laser"][part], sweeps.arrays["firing"][part]] = sweeps.arrays["range_m"][part]
    true_m = true_m[LASERS].reshape(-1)
    returned = rendered.hit >= 0.4
    both = returned & np.isfinite(true_m)
    near = np.abs(rendered.range_m[both] - true_m[both]) < 0.02 * true_m[both] + 0.05
    return float((returned == np.isfinite(true_m)).mean()), float(near.mean())


def test_held_out_scans_of_any_clock_are_answered_alike(right: Callable[[str], tuple[float, float]]) -> None:
    usual = right("behind")
    assert usual[0] > 0.85 and usual[1] > 0.8
    for name in ("in front", "counter-clockwise", "anywhere"):
        hits, ranges = right(name)
        assert hits > usual[0] - 0.01 and ranges > usual[1] - 0.01, name
