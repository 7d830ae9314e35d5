"""A static scene allocates and asks for nothing dynamic."""

import sys
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.models.residual.family import make_fields
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import ResidualRecipe
from nvsf_core.recording.drive import Recording
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.stages import Outcome, plan_run, run_named_stage
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.record import read_record
from tests.stages.lidar_drive import proven_drive

OF_MOTION = (
    "evidence/moving/objects.py",
    "evidence/moving/object_evidence.py",
    "evidence/moving/soft_motion.py",
)
FUNCTIONS_OF_MOTION = {"object_surfaces", "join_surfaces", "object_places"}


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, Outcome]:
    """The tiny drive, in which nothing is seen often enough to be proven to move."""
    folder = tmp_path_factory.mktemp("static")
    write_demo(folder / "drive", size=DemoSize.tiny())
    scene = SceneEntry(
        name="tiny", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        test_frames=(2,),
    )  # fmt: skip
    run = plan_run(scene, folder / "home", recipe="smoke")
    for stage in ("frames", "sweeps", "pano", "undistorted"):
        run_named_stage(stage, run, lambda line: None)
    outcome = run_named_stage("evidence", run, lambda line: None)
    return read_recording(run.store), outcome


def test_a_static_scene_says_so(static: tuple[Recording, Outcome]) -> None:
    recording, outcome = static
    assert recording.lidar is not None and not recording.lidar.evidence.objects
    said = outcome.metadata
    assert said["moving_objects"] == 0 and "moving_objects_with_flow" not in said


def test_a_scene_in_which_objects_move_says_how_many(tmp_path: Path) -> None:
    run = proven_drive(tmp_path, preset("smoke"), firings=200, held_out=(4,), traffic=2)
    recording, record = read_recording(run.store), read_record(run.store.require("evidence"))
    assert recording.lidar is not None and record is not None
    objects, said = recording.lidar.evidence.objects, record["metadata"]
    assert said["moving_objects"] == len(objects) > 0
    assert said["moving_objects_with_flow"] == sum(one.flow_m is not None for one in objects)
    assert 0.0 < said["moving_returns_share"] < 0.5


def test_a_static_scene_allocates_nothing_that_depends_on_time(static: tuple[Recording, Outcome]) -> None:
    recording, _ = static
    assert recording.lidar is not None and recording.lidar.moving() is None
    recipe = preset("smoke")
    assert isinstance(recipe, ResidualRecipe)
    # Of what moves a drive stores each object's rays and path.
    stored = recording.lidar.evidence.to_arrays()
    assert stored and not [name for name in stored if name.startswith("object_")]
    fields = make_fields(recipe, recording, 0)
    names = fields.tensors()
    assert {name.split(".")[0] for name in names} == {"lidar", "hits"}
    assert not [name for name in names if any(w in name for w in ("time", "flow", "dynamic"))]


def test_a_static_scene_asks_nobody_about_motion(static: tuple[Recording, Outcome]) -> None:
    recording, _ = static
    recipe = preset("smoke")
    assert recording.lidar is not None and isinstance(recipe, ResidualRecipe)
    field = make_fields(recipe, recording, 0).lidar
    assert field is not None
    called: set[str] = set()
    functions: set[str] = set()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            called.add(frame.f_code.co_filename)
            functions.add(frame.f_code.co_name)

    lidar = recording.lidar
    rays = [lidar.sweeps.arrays[name][:256] for name in ("origin_m", "direction")]
    sys.setprofile(note)
    try:
        render = field_renderer(field, lidar.evidence.static, lidar.moving(), most=8, far_m=lidar.far_m)
        with torch.no_grad():
            rendered = render(*rays, np.ones(256, np.float32), np.zeros(256))
    finally:
        sys.setprofile(None)
    assert np.isfinite(rendered.range_m).any()
    assert any(name.endswith("fields/lidar_field.py") for name in called)
    assert not [name for name in called if name.endswith(OF_MOTION)]
    assert not functions & FUNCTIONS_OF_MOTION


def test_a_renderer_s_own_surfels_are_read_back_and_without_them_it_has_those_of_the_field(
    static: tuple[Recording, Outcome],
) -> None:
    recording, outcome = static
    assert recording.lidar is not None
    evidence = recording.lidar.evidence
    own = evidence.rendered
    assert own is not None and evidence.for_rendering is own
    assert own.index.voxel_m * own.index.edges.max() <= outcome.metadata["coarsest_voxel_m"]
    assert len(own.precision) == own.index.voxel_count and len(evidence.static.precision) == 0
    again = SceneEvidence.from_arrays(evidence.to_arrays()).for_rendering.to_arrays()
    assert all(np.array_equal(again[name], value) for name, value in own.to_arrays().items())
    assert replace(evidence, rendered=None).for_rendering is evidence.static
