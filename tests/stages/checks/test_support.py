"""The check of how much of a view is guessed."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.geometry.camera_fan import camera_rays
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.checks.support import check_support
from nvsf_core.stages.runner.stage import RunConfig, Task
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.scene_store import SceneStore


@pytest.fixture
def task(tmp_path: Path) -> Task:
    scene = SceneEntry(
        name="short", root=tmp_path / "drive", sequence="2013_05_28_drive_0000_sync", first_frame=0,
        last_frame=9, test_frames=(4,),
    )  # fmt: skip
    config = RunConfig(recipe=preset("smoke"), seed=0, draw_seed=0, dataset_label="manual")
    store = SceneStore(home=tmp_path / "home", scene="short")
    return Task(scene=scene, store=store, config=config, folder=tmp_path / "views", progress=lambda _: None)


def write_view(task: Task, name: str, returns: np.ndarray, pixels: np.ndarray) -> None:
    (task.folder / name).mkdir(parents=True)
    arrays = {"support": returns.astype(np.uint8), "image_00_support": pixels.astype(np.uint8)}
    write_arrays(task.folder / name / "model.zarr", arrays, {"cameras": ["image_00"]})
    write_lens(task, np.ones((10, 10), bool))


def write_lens(task: Task, valid: np.ndarray) -> None:
    write_arrays(task.store.path("undistorted") / "images.zarr", {"image_00_valid": valid}, {})


def test_pixels_outside_of_the_lens_are_not_guessed(task: Task) -> None:
    pixels = np.full((1, 10, 10), 2)
    pixels[0, :3] = 0
    write_view(task, "near", np.full(100, 2), pixels)
    (doubted,) = check_support(task)
    assert not doubted.passed
    circle = np.ones((10, 10), bool)
    circle[:3] = False
    write_lens(task, circle)
    (held,) = check_support(task)
    assert held.passed and held.value == 0.0


def test_a_fisheye_of_ones_own_is_judged_inside_its_circle(task: Task) -> None:
    lens = MeiFisheye(
        xi=2.2,
        k1=0.0,
        k2=0.0,
        p1=0.0,
        p2=0.0,
        gamma1=28.0,
        gamma2=28.0,
        u0=31.5,
        v0=31.5,
        width=64,
        height=64,
    )
    _, seen = camera_rays(lens)
    assert 0.1 < np.mean(~seen) < 0.9
    (task.folder / "fish").mkdir(parents=True)
    support = np.where(seen, 2, 0)[None].astype(np.uint8)
    facts = {"cameras": ["fish"], "camera_models": {"fish": {"kind": "mei", **asdict(lens)}}}
    write_arrays(task.folder / "fish" / "model.zarr", {"fish_support": support}, facts)
    write_lens(task, np.ones((10, 10), bool))
    (held,) = check_support(task)
    assert held.passed and held.value == 0.0


def test_the_worst_of_all_scans_and_images_is_judged(task: Task) -> None:
    write_view(task, "near", np.full(100, 2), np.full((1, 10, 10), 2))
    (held,) = check_support(task)
    assert held.passed
    pixels = np.full((1, 10, 10), 1)
    pixels[0, :3] = 0
    write_view(task, "far", np.full(100, 2), pixels)
    (doubted,) = check_support(task)
    assert not doubted.passed
    assert "view far" in doubted.detail and "pixels of image_00 30 guessed" in doubted.detail


def test_without_support_the_check_says_that_it_was_not_run(task: Task) -> None:
    (found,) = check_support(task)
    assert "not run" in f"{found.detail}"
