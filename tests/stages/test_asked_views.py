"""Views of the catalogue whose truth is known: rendered by all methods, measured, and shown beside it."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import MissingLibraryError
from nvsf_core.recipe import FieldSpec, TrainingSpec, preset
from nvsf_core.rendering.support import Support
from nvsf_core.stages import Outcome, mesh, novel_views, plan_run, run_named_stage, scene_metrics
from nvsf_core.stages.runner.contents import truth_digest
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.file_hashes import FileHashes
from nvsf_core.stores.tables import read_rows

VIEWS = (
    ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0), frames=(1,)),
    ViewEntry(name="between", times_s=(0.05, 0.15)),
    ViewEntry(name="vlp16", sensor="VLP-16", frames=(1,)),
)
_GRID = FieldSpec(levels=2, log2_table=8)
SMOKE = replace(
    preset("smoke"),
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=20, rays=128),
    depth_training=TrainingSpec(steps=5, rays=512),
    camera_training=TrainingSpec(steps=5, rays=512),
)
STAGES = (
    "frames", "sweeps", "pano", "undistorted", "evidence", "mesh", "field", "novel_views", "scene_metrics",
)  # fmt: skip
METHODS = {"model", "reproject", "copy_nearest"}


@dataclass(frozen=True)
class Run:
    plan: SceneRun
    outcomes: dict[str, Outcome]

    @property
    def root(self) -> Path:
        return self.plan.store.root

    def rows(self, view: str) -> list[dict]:
        table = self.root / "scene_metrics/smoke/0/metrics.parquet"
        return [row for row in read_rows(table) if row["split"] == view]

    def stored(self, view: str, method: str) -> Path:
        return self.root / "novel_views/smoke/0" / view / f"{method}.zarr"


def _missing(*_: object, **__: object) -> None:
    """LPIPS and the mesh take most of a tiny scene's time; a user may have neither."""
    raise MissingLibraryError("left out by this test")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("asked")
    write_demo(folder / "drive", size=DemoSize.tiny())
    entry = SceneEntry(
        name="tiny", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        test_frames=(2,), views=VIEWS,
    )  # fmt: skip
    plan = plan_run(entry, folder / "home", recipe=SMOKE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_metrics, "load_lpips", lambda: None)
        patch.setattr(mesh, "poisson_mesh", _missing)
        outcomes = {name: run_named_stage(name, plan, lambda line: None) for name in STAGES}
    return Run(plan, outcomes)


def test_every_method_renders_the_images_of_a_view_of_the_demo(run: Run) -> None:
    for view, images in (("shift_1m", 1), ("between", 2)):
        for method in METHODS:
            path = run.stored(view, method)
            assert read_attrs(path)["cameras"] == ["image_00"]
            assert len(read_arrays(path, "image_00_rgb")["image_00_rgb"]) == images
    assert not run.stored("vlp16", "copy_nearest").exists()
    assert read_attrs(run.stored("vlp16", "reproject"))["cameras"] == []


def test_a_copied_image_is_the_training_image_nearest_to_the_view(run: Run) -> None:
    recorded = read_arrays(run.root / "undistorted/images.zarr", "image_00_rgb")["image_00_rgb"]
    copied = read_arrays(run.stored("between", "copy_nearest"), "image_00_rgb")["image_00_rgb"]
    # Frame 2 is held out, so half-way to it frame 1 is the nearest that was trained on.
    assert (copied == recorded[[0, 1]]).all()


def test_images_of_the_demos_views_are_measured_beside_their_sweeps(run: Run) -> None:
    for view, images in (("shift_1m", 1), ("between", 2)):
        rows = [row for row in run.rows(view) if row["protocol"] == "image"]
        assert {row["recipe"] for row in rows} == {"smoke", *METHODS - {"model"}}
        assert {row["sensor"] for row in rows} == {"image_00"}
        for metric in ("image_psnr_db", "image_ssim", "image_missing"):
            whole = [row for row in rows if row["region"] == "all"]
            values = [row["value"] for row in whole if row["metric"] == metric]
            assert len(values) == images * len(METHODS) and np.isfinite(values).all()
        # Where the networks are shown, also by the support of their pixels.
        assert {row["region"] for row in rows} <= {"all", *(support.region for support in Support)}
        assert {row["protocol"] for row in run.rows(view)} == {"raw", "image"}
    assert {row["sensor"] for row in run.rows("vlp16")} == {"lidar"}
    assert any(key.startswith("shift_1m/smoke/image/") for key in run.outcomes["scene_metrics"].metadata)


def test_the_truth_lies_beside_the_metrics_and_views_without_images_have_none(run: Run) -> None:
    folder = run.root / "scene_metrics/smoke/0"
    truth = read_arrays(folder / "between/truth.zarr")
    shown = read_arrays(run.stored("between", "model"), "image_00_rgb")["image_00_rgb"]
    assert truth["image_00_rgb"].shape == shown.shape and truth["image_00_row"].tolist() == [0, 1]
    assert (folder / "shift_1m/truth.zarr").is_dir() and not (folder / "vlp16").exists()


def _without_world(run: Run, folder: Path, views: tuple[ViewEntry, ...], seed: int = 0) -> Task:
    """A task on the same outputs, of a drive that is not the demo's: nobody knows its world."""
    folder.mkdir()
    scene = replace(run.plan.scene, sequence="2013_05_28_drive_0000_sync", views=views)
    config = replace(run.plan.config, seed=seed)
    return Task(scene=scene, store=run.plan.store, config=config, folder=folder, progress=lambda line: None)


@pytest.fixture(scope="module")
def recorded(run: Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict]]:
    """What was published of a view whose truth was recorded (frames 1 and 3, as they are), and its rows."""
    folder = tmp_path_factory.mktemp("recorded")
    images = DriveLayout(run.plan.scene.root, DEMO_SEQUENCE)
    for frame in (1, 3):
        path = images.image_path("image_00", frame)
        (folder / "truth").mkdir(exist_ok=True)
        shutil.copy(path, folder / "truth" / path.name)
    view = ViewEntry(name="second_camera", frames=(1, 3), truth=(("image_00", folder / "truth"),))
    unknown = ViewEntry(name="unknown", frames=(1,))
    task = _without_world(run, folder / "views", (view, unknown))
    novel_views.STAGE.run(task)
    published = run.plan.store.path("novel_views/smoke/1")
    shutil.move(task.folder, published)
    measuring = _without_world(run, folder / "metrics", (view, unknown), seed=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_metrics, "load_lpips", lambda: None)
        scene_metrics.STAGE.run(measuring)
    assert [path.parent.name for path in measuring.folder.glob("*/truth.zarr")] == ["second_camera"]
    return published, read_rows(measuring.folder / "metrics.parquet")


def test_a_view_with_recorded_truth_is_measured_by_its_images_alone(
    recorded: tuple[Path, list[dict]],
) -> None:
    published, rows = recorded
    mine = [row for row in rows if row["split"] == "second_camera"]
    assert {(row["protocol"], row["sensor"]) for row in mine} == {("image", "image_00")}
    assert {row["recipe"] for row in mine} == {"smoke", *METHODS - {"model"}}
    assert {row["frame"] for row in mine} == {1, 3}
    copied = [
        row["value"] for row in mine if (row["recipe"], row["metric"]) == ("copy_nearest", "image_ssim")
    ]
    assert copied == [1.0, 1.0], "frames 1 and 3 were trained on, and copied"
    for method in METHODS:
        assert bool(read_attrs(published / "second_camera" / f"{method}.zarr")["sensor"]) == (
            method == "model"
        )
    assert [path.name for path in (published / "unknown").glob("*.zarr")] == ["model.zarr"]
    assert not [row for row in rows if row["split"] == "unknown"]


def test_changed_true_images_are_measured_again_and_render_nothing_anew(run: Run, tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    source = DriveLayout(run.plan.scene.root, DEMO_SEQUENCE).image_path("image_00", 1)
    shutil.copy(source, tmp_path / "truth")
    view = ViewEntry(name="v", frames=(1,), truth=(("image_00", tmp_path / "truth"),))
    scene = replace(run.plan.scene, views=(view,))

    def digest(scene: SceneEntry) -> str:
        with FileHashes(tmp_path / "hashes.json") as hashes:
            return truth_digest(scene, hashes)

    before = digest(scene)
    assert before == digest(scene) != digest(replace(scene, views=()))
    (tmp_path / "truth" / source.name).write_bytes(source.read_bytes() + b" ")
    assert digest(scene) != before
    assert scene_metrics.STAGE.reads_truth and not novel_views.STAGE.reads_truth
