"""Laws of cameras that share their images, on the demo's stereo pair and side camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize
from nvsf_core.geometry.se3 import exp_se3
from nvsf_core.models.family import TrainedPart
from nvsf_core.models.residual.camera import ALONE, LEARNED, SHARED, TONES, camera_renderer, train_camera
from nvsf_core.models.residual.camera_examples import ShownCamera
from nvsf_core.models.residual.dynamic_masks import MovingWorld
from nvsf_core.models.residual.pose_refinement import aligned_by
from nvsf_core.models.residual.shared_images import shared_by, shared_images
from nvsf_core.models.residual.tones import ToneCurve
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import CameraSpec
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.camera_view import shown_images, shrinking
from nvsf_core.stages import SceneRun
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.checkpoints import StageSession
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.checkpoints import StoredWeights
from tests.models.residual.conftest import Prepare

FRAMES = 6
PAIR = ("image_00", "image_01")
CAMERAS = (*PAIR, "image_02")
SIZE = replace(DemoSize.tiny(), frames=FRAMES, cameras=CAMERAS)


@pytest.fixture(scope="module")
def run(prepare: Prepare) -> SceneRun:
    """The demo as far as training reads it, all frames for training."""
    return prepare("shared", SIZE)


@pytest.fixture(scope="module")
def drive(run: SceneRun) -> Recording:
    return read_recording(run.store)


def shown(drive: Recording, camera: str) -> ShownCamera:
    (shared,) = (one for one in shared_images(drive, CAMERAS) if camera in one.cameras)
    images, spec = drive.cameras[camera].training, CameraSpec()
    factor = shrinking(images.pinhole, spec)
    sources = shown_images(shared.rgb(drive), images.valid, factor)
    return ShownCamera(aligned_by(MovingWorld(drive), {}), camera, shared, sources, spec)


def test_a_stereo_pair_shares_and_a_side_camera_does_not(drive: Recording) -> None:
    assert [one.cameras for one in shared_images(drive, CAMERAS)] == [PAIR, ("image_02",)]
    assert [one.cameras for one in shared_images(drive, PAIR[:1])] == [PAIR[:1]]
    right = drive.cameras[PAIR[1]]
    grey = np.repeat(right.training.rgb[..., 1:2], 3, axis=-1)
    zoomed = replace(right.training.pinhole, fx=right.training.pinhole.fx * 1.01)
    others = (
        replace(right, training=replace(right.training, pinhole=zoomed)),
        replace(right, training=replace(right.training, pixel=right.training.pixel[:-1])),
        replace(right, training=replace(right.training, rgb=grey)),
        replace(right, training_frame=right.training_frame + 1),
        replace(right, in_lidar=right.in_lidar @ exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))),
    )
    for other in others:
        changed = replace(drive, cameras=drive.cameras | {PAIR[1]: other})
        assert [one.cameras for one in shared_images(changed, PAIR)] == [PAIR[:1], PAIR[1:]]


def test_numbers_are_those_of_poses_images_and_instants(drive: Recording) -> None:
    (shared,) = shared_by(drive, [PAIR])
    for camera in PAIR:
        one = drive.cameras[camera]
        for index in range(FRAMES):
            number = shared.number(camera, index)
            assert np.array_equal(shared.poses(drive)[number], one.training.pose[index])
            assert np.array_equal(shared.rgb(drive)[number], one.training.rgb[index])
            assert shared.times_s(drive)[number] == one.training_time_s[index]
            instant = shared.at_instant_of(index)
            assert number in instant and len(instant) == 2
            assert {int(shared.instant[each]) for each in instant} == {index}
            assert (number in shared.of_others(camera)) is False
    assert shared.of_others(PAIR[0]) | shared.of_others(PAIR[1]) == set(range(2 * FRAMES))


def test_the_distance_from_the_path_is_that_from_the_nearest_way_between_two_images(drive: Recording) -> None:
    (shared,) = shared_by(drive, [PAIR])
    left, right = (drive.cameras[camera].training.pose for camera in PAIR)
    half_way_m = left[2:4, :3, 3].mean(axis=0)
    assert shared.off_path_m(drive, half_way_m) < 1e-9
    ahead, up = left[3, :3, 3] - left[2, :3, 3], np.array([0.0, 0.0, 1.0])
    left_m = np.cross(up, ahead) / np.linalg.norm(np.cross(up, ahead))
    assert shared.off_path_m(drive, half_way_m + 3.0 * left_m) == pytest.approx(3.0, abs=0.05)
    to_right_m = np.linalg.norm(right[2, :3, 3] - left[2, :3, 3])
    of_right = shared.off_path_m(drive, half_way_m - 3.0 * left_m)
    assert of_right == pytest.approx(3.0 - to_right_m, abs=0.05), "of the nearer camera's path"
    onwards = left[-1, :3, 3] - left[-2, :3, 3]
    beyond_m = left[-1, :3, 3] + 2.0 * onwards / np.linalg.norm(onwards)
    assert shared.off_path_m(drive, beyond_m) == pytest.approx(2.0, abs=0.6), "from the path's end"


def test_the_path_of_one_image_is_its_place(drive: Recording) -> None:
    images = drive.cameras[PAIR[0]].training
    one = replace(images, pose=images.pose[:1], rgb=images.rgb[:1])
    alone = replace(drive, cameras={PAIR[0]: replace(drive.cameras[PAIR[0]], training=one)})
    (shared,) = shared_by(alone, [PAIR[:1]])
    aside_m = images.pose[0, :3, 3] + np.array([0.0, 3.0, 4.0])
    assert shared.off_path_m(alone, aside_m) == pytest.approx(5.0)


@pytest.mark.parametrize("camera", CAMERAS)
def test_an_image_is_never_rendered_from_another_of_its_instant(drive: Recording, camera: str) -> None:
    one = shown(drive, camera)
    for index in range(FRAMES):
        instant = one.shared.at_instant_of(index)
        assert not instant & set(one.from_others(index).near.chosen)
        own = set(one.from_others(index, alone=True).near.chosen)
        assert not own & (one.shared.of_others(camera) | instant)
    assert not set(one.training) & set(one.validation)


def test_each_image_has_the_other_of_its_instant_beside_it_for_its_depth(drive: Recording) -> None:
    one = shown(drive, PAIR[0])
    for index in one.training:
        sources = one.itself(index).view.near.chosen
        assert sources[0] == one.shared.number(PAIR[0], index)
        assert one.shared.number(PAIR[1], index) in sources
        assert not one.for_validation & set(sources)


def trained_once(run: SceneRun, drive: Recording, folder: Path) -> TrainedPart:
    recipe = replace(preset("smoke"), depth_training=replace(preset("smoke").depth_training, steps=1))
    config = replace(run.config, recipe=recipe)
    task = Task(scene=run.scene, store=run.store, config=config, folder=folder, progress=lambda _: None)
    return train_camera(StageSession(task, folder), recipe, drive)


def images(trained: TrainedPart, drive: Recording, facts: dict[str, object]) -> dict[str, np.ndarray]:
    """A view half-way between two images of each camera, by the learned depths."""
    weights = StoredWeights(trained.tensors, facts, Path("weights.safetensors"))
    render = camera_renderer(drive, preset("smoke").camera, weights)
    found = {}
    for name in CAMERAS:
        one = drive.cameras[name]
        pose, time_s = one.training.pose[2:4].mean(axis=0), float(one.training_time_s[2:4].mean())
        found[name] = render(name, one.training.pinhole, pose, time_s).rgb
    return found


def test_a_pair_has_one_set_of_depth_maps_and_each_camera_may_do_without_the_others_images(
    run: SceneRun, drive: Recording, tmp_path: Path
) -> None:
    trained = trained_once(run, drive, tmp_path)
    assert trained.facts[SHARED] == [list(PAIR), ["image_02"]]
    assert trained.facts[TONES] == {}, "both look alike"
    maps = {name: len(one) for name, one in trained.tensors.items() if name.endswith("inverse")}
    assert maps == {"depth_maps.image_00.inverse": 2 * FRAMES, "depth_maps.image_02.inverse": FRAMES}
    judged = [f"{name}_judged_shared_gain_db" in trained.metadata for name in CAMERAS]
    assert judged == [True, True, False]

    facts = trained.facts | {LEARNED: list(CAMERAS), ALONE: []}
    shared = images(trained, drive, facts)
    alone = images(trained, drive, facts | {ALONE: ["image_01"]})
    assert [np.array_equal(shared[name], alone[name]) for name in CAMERAS] == [True, False, True]


def test_each_camera_of_a_pair_keeps_its_own_exposure(
    run: SceneRun, drive: Recording, tmp_path: Path
) -> None:
    right = drive.cameras[PAIR[1]].training
    darker = replace(right, rgb=ToneCurve((0.7,) * 3, (1.1,) * 3).of(right.rgb))
    cameras = drive.cameras | {PAIR[1]: replace(drive.cameras[PAIR[1]], training=darker)}
    drive = replace(drive, cameras=cameras)
    trained = trained_once(run, drive, tmp_path)
    assert list(trained.facts[TONES]) == [PAIR[1]]
    assert min(trained.metadata[f"{name}_judged_psnr_db"] for name in PAIR) > 10.0
    shown = images(trained, drive, trained.facts | {LEARNED: list(CAMERAS), ALONE: []})
    for name in PAIR:
        recorded = drive.cameras[name].training.rgb[2:4].mean()
        assert abs(shown[name].mean() - recorded) < 5.0
    assert shown[PAIR[0]].mean() - shown[PAIR[1]].mean() > 20.0
