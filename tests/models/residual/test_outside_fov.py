"""A sensor that looks above the recorded lasers: images answer there, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize
from nvsf_core.demo.lidar import exact_rays
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.catalogue import ViewEntry
from nvsf_core.drives.view_parts import SensorEntry
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.models.residual.outside_fov import looks_above, seen_above
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.beam_table import firing_grid
from nvsf_core.simulation.raydrop import rays_return
from nvsf_core.simulation.sweep_simulation import SimulatedSweep, highest_rad, simulate_sweep
from nvsf_core.simulation.view_plan import SweepPlan
from nvsf_core.stages import SceneRun
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.views.view import asked_view
from tests.models.residual.conftest import Prepare

FRAMES, AT = 9, 4
SIZE = DemoSize(
    frames=FRAMES, lasers=tuple(range(10, 64, 3)), firings=600, cameras=("image_00",), width=352, height=94,
    fisheye_side=0,
)  # fmt: skip
VLP_16 = ViewEntry(name="vlp16", sensor="VLP-16", frames=(AT,))


@pytest.fixture(scope="module")
def run(prepare: Prepare) -> SceneRun:
    """The demo without its upper ten lasers, as far as rendering without learning reads it."""
    return prepare("above", SIZE)


@pytest.fixture(scope="module")
def drive(run: SceneRun) -> Recording:
    return read_recording(run.store)


@pytest.fixture(scope="module")
def both(run: SceneRun, drive: Recording) -> tuple[SimulatedSweep, SimulatedSweep]:
    """A sweep as `reproject` has it, and with what images show."""
    above = seen_above(drive, lambda _: None)
    assert above is not None
    return _sweep(drive, None), _sweep(drive, above)


def _plan(drive: Recording, entry: ViewEntry) -> SweepPlan:
    view = asked_view(drive, entry)
    assert view is not None and view.sweeps is not None
    return view.sweeps


def _sweep(drive: Recording, above, entry: ViewEntry = VLP_16) -> SimulatedSweep:
    lidar, plan, model = drive.lidar, _plan(drive, entry), reprojection(drive)
    assert lidar is not None
    model = replace(model, above=above)
    return simulate_sweep(model, lidar, plan, float(plan.time_s[0]))


def test_only_lasers_above_all_that_recorded_ask_images(drive: Recording) -> None:
    lidar = drive.lidar
    assert lidar is not None
    assert looks_above(lidar, _plan(drive, VLP_16))
    assert not looks_above(lidar, _plan(drive, ViewEntry(name="same", frames=(AT,))))
    assert not looks_above(
        lidar, _plan(drive, ViewEntry(name="aside", shift_m=(0.0, 1.0, 0.0), frames=(AT,)))
    )
    unobserved = replace(lidar, evidence=replace(lidar.evidence, lasers=np.zeros(0, np.int16)))
    assert not looks_above(unobserved, _plan(drive, VLP_16)), "nobody knows where recorded lasers looked"


def test_what_the_lidar_answers_stays_as_it_is(both: tuple[SimulatedSweep, SimulatedSweep]) -> None:
    without, with_images = both
    answered = without.grid["grid_range_m"] > 0.0
    for name, values in without.grid.items():
        assert np.array_equal(values[answered], with_images.grid[name][answered]), name
    more = (with_images.grid["grid_range_m"] > 0.0) & ~answered
    assert more.sum() > 200


def test_images_tell_more_of_the_demo_s_truth_than_silence_does(
    drive: Recording, both: tuple[SimulatedSweep, SimulatedSweep]
) -> None:
    plan = _plan(drive, VLP_16)
    azimuth, fraction = firing_grid(plan.table, both[0].grid["grid_hit"].shape[1])
    lidar = drive.lidar
    assert lidar is not None
    exact = exact_rays(
        DemoWorld(), plan.table, np.arange(plan.table.laser_count), azimuth,
        np.broadcast_to(0.1 * AT + 0.1 * fraction, azimuth.shape), mount=None, own_vehicle=False,
    )  # fmt: skip
    returns = rays_return(exact.chance)
    silent = both[0].grid["grid_range_m"] == 0.0
    says = rays_return(both[1].grid["grid_hit"])
    assert silent.mean() > 0.2
    right_before, right_now = (returns[silent] == said[silent] for said in (np.zeros_like(says), says))
    assert right_now.mean() > right_before.mean() + 0.03
    true = says & silent & returns
    assert true.sum() > 2.0 * (says & silent & ~returns).sum()
    # This sensor's lasers have no levers to speak of: the range from its centre is that along the ray.
    error_m = np.abs(both[1].grid["grid_range_m"] - exact.range_m)[true]
    assert np.median(error_m) < 1.0


TILTED_UP = (
    ViewEntry(
        name="up", pitch_deg=-15.0, frames=(AT,),
        sensor=SensorEntry(name="down", elevation_deg=(-2.0, -6.0, -10.0)),
    ),
    ViewEntry(name="recorder_up", pitch_deg=-15.0, frames=(AT,)),
)  # fmt: skip
"""Sensors none of whose lasers lies above the recorded ones, but which look there ahead."""


@pytest.mark.parametrize("entry", TILTED_UP, ids=lambda entry: entry.name)
def test_a_sensor_that_is_tilted_up_asks_images_where_it_looks_above(
    drive: Recording, entry: ViewEntry
) -> None:
    lidar, plan = drive.lidar, _plan(drive, entry)
    assert lidar is not None and looks_above(lidar, plan)
    assert not looks_above(lidar, _plan(drive, replace(entry, pitch_deg=0.0, yaw_deg=30.0)))
    asked_rad: list[np.ndarray] = []

    def answer(origin_m, direction, hit_prior, time_s) -> RenderedRays:
        asked_rad.append(np.arcsin(direction[:, 2]))
        return RenderedRays(*(np.full(len(hit_prior), one, np.float32) for one in (9.0, 0.9, 0.5)))

    swept = _sweep(drive, answer, entry)
    highest = highest_rad(lidar.sweeps.table, lidar.evidence)
    assert len(asked_rad) == 1 and len(asked_rad[0]) > 100
    # The demo's road is level, and its car hardly pitches; recorded rays are turned up by 0.2 degrees.
    assert asked_rad[0].min() > highest - 0.01 and asked_rad[0].max() < highest + np.radians(20.0)
    assert (np.abs(swept.grid["grid_range_m"] - 9.0) < 0.5).sum() > 100


def test_the_recording_sensor_asks_no_image(drive: Recording) -> None:
    def never(*_: np.ndarray):
        raise AssertionError("asked")

    _sweep(drive, never, ViewEntry(name="aside", shift_m=(0.0, 1.0, 0.0), frames=(AT,)))


def test_without_images_nobody_knows(run: SceneRun, drive: Recording) -> None:
    assert seen_above(replace(drive, cameras={}), lambda _: None) is None
    assert seen_above(replace(drive, lidar=None), lambda _: None) is None
