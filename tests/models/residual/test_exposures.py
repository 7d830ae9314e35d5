"""A camera whose exposure changes from image to image, through the real stages."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nvsf_core.demo.drive import DemoSize
from nvsf_core.models.residual.camera import EXPOSURES, LEARNED, camera_renderer, train_camera
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.exposures import Exposures, evened, exposures_of
from nvsf_core.models.residual.pose_refinement import facts_of, from_facts
from nvsf_core.recipe.presets import preset
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.image_exposure import at_exposure
from nvsf_core.stages import SceneRun
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.checkpoints import StoredWeights
from tests.models.residual.conftest import Prepare

FRAMES = 6
CAMERA = "image_00"
SIZE = DemoSize(
    frames=FRAMES, lasers=tuple(range(0, 64, 2)), firings=700, cameras=(CAMERA,), width=192, height=96,
    fisheye_side=0,
)  # fmt: skip
TRUE = np.array([0.0, -0.05, -0.35, -0.3, -0.1, -0.15])


@pytest.fixture(scope="module")
def run(prepare: Prepare) -> SceneRun:
    return prepare("exposed", SIZE)


@pytest.fixture(scope="module")
def fixed(run: SceneRun) -> Recording:
    return read_recording(run.store)


def taken_with(recording: Recording, log_gain: np.ndarray) -> Recording:
    """The drive, whose images were taken with these gains."""
    one = recording.cameras[CAMERA]
    levels = (
        at_exposure(torch.from_numpy(image) / 255.0, float(gain))
        for image, gain in zip(one.training.rgb, log_gain, strict=True)
    )
    rgb = np.stack([(255.0 * each).round().to(torch.uint8).numpy() for each in levels])
    return replace(recording, cameras={CAMERA: replace(one, training=replace(one.training, rgb=rgb))})


@pytest.fixture(scope="module")
def drive(fixed: Recording) -> Recording:
    """The drive taken with a camera of changing exposure."""
    return taken_with(fixed, TRUE)


def test_a_fixed_exposure_is_left_alone_and_a_changing_one_is_found(
    fixed: Recording, drive: Recording
) -> None:
    assert exposures_of(MovingWorld(fixed), [CAMERA]) == {}
    assert exposures_of(MovingWorld(replace(drive, lidar=None)), [CAMERA]) == {}, "nothing tells"
    found = exposures_of(MovingWorld(drive), [CAMERA])[CAMERA].log_gain
    assert found - found.mean() == pytest.approx(TRUE - TRUE.mean(), abs=0.03)


def test_what_drifts_along_a_drive_is_no_exposure(fixed: Recording) -> None:
    drifting = taken_with(fixed, -0.02 * np.arange(FRAMES))
    assert exposures_of(MovingWorld(drifting), [CAMERA]) == {}


def test_evened_images_look_as_if_taken_with_one_exposure(fixed: Recording, drive: Recording) -> None:
    exposures = exposures_of(MovingWorld(drive), [CAMERA])[CAMERA]
    rgb, was = drive.cameras[CAMERA].training.rgb, fixed.cameras[CAMERA].training.rgb
    even = np.stack([evened(exposures, rgb, index) for index in range(FRAMES)])
    assert np.array_equal(evened(None, rgb, 1), rgb[1])
    # All are darker than the fixed ones by a common gain: only their ratios are equal.
    ratios = [np.median(a[b > 20] / b[b > 20].astype(np.float64)) for a, b in zip(even, was, strict=True)]
    assert np.ptp(np.log(ratios)) < 0.05 < np.ptp(TRUE)


def test_exposures_between_images_and_as_the_other_images_tell_them() -> None:
    one = Exposures(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.5, -0.1]))
    assert [one.at(t) for t in (-1.0, 0.5, 1.0, 2.0, 9.0)] == pytest.approx([0.0, 0.25, 0.5, 0.2, -0.1])
    assert one.at(1.0, leave_out=True) == pytest.approx(-0.1 / 3.0)
    assert Exposures(np.zeros(1), np.full(1, 0.3)).at(0.0, leave_out=True) == pytest.approx(0.3)
    back = from_facts(Exposures, json.loads(json.dumps(facts_of({CAMERA: one}))))[CAMERA]
    assert np.array_equal(back.time_s, one.time_s) and np.array_equal(back.log_gain, one.log_gain)


def test_views_have_the_exposure_of_their_time(run: SceneRun, drive: Recording, tmp_path: Path) -> None:
    once = replace(preset("smoke").depth_training, steps=1)
    recipe = replace(preset("smoke"), depth_training=once)
    task = Task(
        scene=run.scene, store=run.store, config=replace(run.config, recipe=recipe), folder=tmp_path,
        progress=lambda _: None,
    )  # fmt: skip
    trained = train_camera(StageSession(task, tmp_path), recipe, drive)
    assert list(trained.facts[EXPOSURES]) == [CAMERA]
    weights = StoredWeights(trained.tensors, trained.facts | {LEARNED: [CAMERA]}, tmp_path / "weights")
    render = camera_renderer(drive, recipe.camera, weights)
    one = drive.cameras[CAMERA]
    for index in (0, 2, 4):
        place = one.training.pinhole, one.training.pose[index], float(one.training_time_s[index])
        shown = render(CAMERA, *place).rgb
        assert abs(shown.mean() - one.training.rgb[index].mean()) < 6.0
    # Of another place's time, as in a frozen instant, the exposure is that of the place.
    dark_s = float(one.training_time_s[2])
    place = one.training.pinhole, one.training.pose[4], float(one.training_time_s[4])
    assert render(CAMERA, *place, dark_s).rgb.mean() < 0.95 * render(CAMERA, *place).rgb.mean()
