"""The paper's system trains and renders on a device that is not the CPU, and finds what the CPU finds."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.recipe.paper import PaperLosses, PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stores.tables import read_table
from tests.other_device import OTHER, other_device

SMOKE = preset("paper_smoke")
assert isinstance(SMOKE, PaperRecipe)
LOSSES = PaperLosses(chamfer=1.0, flow_magnitude=1.0)
# Three frames are an epoch; the second draws by the error map and in patches.
EVERYTHING = replace(
    SMOKE, name="everything", losses=LOSSES, optimiser=replace(SMOKE.optimiser, steps=4),
    sampling=replace(SMOKE.sampling, rays=32, rays_at_once=32),
    refinement=replace(SMOKE.refinement, steps=2, panos=1, column_step=20),
)  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A tiny drive, ready to be trained on."""
    folder = tmp_path_factory.mktemp("other_device")
    write_demo(folder / "drive", size=DemoSize.tiny())
    scene = SceneEntry(
        name="tiny", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        test_frames=(2,),
    )  # fmt: skip
    run = plan_run(scene, folder / "home", recipe=EVERYTHING)
    for stage in ("frames", "sweeps", "pano", "undistorted", "evidence"):
        run_named_stage(stage, run, lambda line: None)
    return run


def test_training_and_rendering_elsewhere_give_what_they_give_on_the_cpu(run):
    recording = read_recording(run.store)
    assert recording.lidar is not None
    a = recording.lidar.sweeps.arrays
    rays = (a["origin_m"][:200], a["direction"][:200], np.ones(200, np.float32), np.full(200, a["time_s"][0]))
    there = plan_run(run.scene, run.store.home, recipe=replace(EVERYTHING, name="there"))
    here_folder = run_named_stage("field", run, lambda line: None).path
    with other_device():
        there_folder = run_named_stage("field", there, lambda line: None).path
        model = load_trained(there_folder, recording)
        assert model.lidar is not None
        found = model.lidar(*rays)
    here, elsewhere = (read_table(folder / "curve.parquet")["loss"] for folder in (here_folder, there_folder))
    assert np.allclose(elsewhere, here, rtol=0.02)
    # Adam's first steps have one size whatever the gradient's: the weights of both drift apart.
    again = load_trained(there_folder, recording)
    assert again.lidar is not None
    assert np.allclose(found.range_m, again.lidar(*rays).range_m, rtol=1e-4, atol=1e-3)


def test_what_cuda_refuses_is_refused():
    with other_device():
        one = torch.ones(3, device=OTHER)
        assert one.device == OTHER and (one + 1.0).sum().item() == 6.0
        with pytest.raises(RuntimeError, match="one device"):
            one + torch.ones(3)
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(3, device=OTHER, generator=torch.Generator())
        with pytest.raises((RuntimeError, TypeError)):
            one.numpy()
