"""Views of the catalogue whose truth is known: rendered by all methods, measured, and shown beside it."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.view_parts import CameraEntry, SensorEntry, Waypoint
from nvsf_core.errors import DataError, MissingLibraryError
from nvsf_core.metrics.table import mean_rows
from nvsf_core.metrics.trust.cues import AWAY, DENSITY, LASERS, ODOMETRY, PROTOCOL, SCORE, WRONG
from nvsf_core.metrics.trust.verdict import Trust, verdicts
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, TrainingSpec
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages import Outcome, mesh, novel_views, plan_run, run_named_stage, scene_metrics
from nvsf_core.stages.flow import NOVEL_VIEWS, SCENE_METRICS
from nvsf_core.stages.render_view import render_view
from nvsf_core.stages.runner.contents import truth_digest
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.rows import Ledger, method_columns
from nvsf_core.stages.scoring.trust.view_rows import measure_trust, recorded_sensors
from nvsf_core.stores.arrays import read_arrays, read_attrs, write_arrays
from nvsf_core.stores.checksums import file_checksums
from nvsf_core.stores.file_hashes import FileHashes
from nvsf_core.stores.tables import read_rows

VIEWS = (
    ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0), frames=(1,)),
    ViewEntry(name="between", times_s=(0.05, 0.15)),
    ViewEntry(name="vlp16", sensor="VLP-16", frames=(1,)),
    ViewEntry(name="frozen", frames=(0, 3), frozen_at_s=0.1),
    ViewEntry(
        name="curve", rate_hz=5.0, frames=(), frozen_at_s=0.1, footprint=True, cameras=(),
        sensor=SensorEntry(
            name="mine", elevation_deg=(0.0, -5.0, -10.0), azimuth_step_deg=4.0, rate_hz=20.0,
            divergence_mrad=3.0,
        ),
        waypoints=(
            Waypoint(time_s=0.0, position_m=(0.0, 0.0, 0.0)),
            Waypoint(time_s=0.5, position_m=(3.0, 0.5, 0.2), yaw_deg=10.0),
        ),
        camera=(CameraEntry(name="image_10", like="image_00", width=32, height=24, focal_px=40.0),),
    ),
)  # fmt: skip
_GRID = FieldSpec(levels=2, log2_table=8)
SMOKE = replace(
    preset("smoke"),
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=20, rays=128),
    depth_training=TrainingSpec(steps=5, rays=512),
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


def test_a_frozen_instant_is_rendered_from_a_moving_car_and_measured(run: Run) -> None:
    recorded = read_rows(run.root / "frames/frames.parquet")
    for method in METHODS:
        shown = read_arrays(run.stored("frozen", method))
        assert shown["time_s"].tolist() == [0.1, 0.1]
        assert np.allclose(shown["path_time_s"], [recorded[0]["time_s"], recorded[3]["time_s"]])
        assert shown["frame"].tolist() == [0, 3]
        poses = np.array([recorded[k]["lidar_to_world"] for k in (0, 3)]).reshape(2, 4, 4)
        assert np.allclose(shown["lidar_to_world"], poses, atol=1e-9)
        rows = [
            row for row in run.rows("frozen") if row["recipe"] == ("smoke" if method == "model" else method)
        ]
        assert {row["sensor"] for row in rows} == {"lidar", "image_00"}


def test_a_path_sensor_and_camera_of_ones_own_are_rendered_and_measured(run: Run) -> None:
    shown, attrs = read_arrays(run.stored("curve", "model")), read_attrs(run.stored("curve", "model"))
    assert shown["stamp_s"].tolist() == pytest.approx([0.0, 0.2, 0.4]) and shown["number"].tolist() == [
        0,
        1,
        2,
    ]
    assert attrs["sensor"] == "mine" and attrs["sweep_period_s"] == 0.05 and attrs["cameras"] == ["image_10"]
    assert shown["grid_hit"].shape == (3, 3, 90) and shown["image_10_rgb"].shape == (3, 24, 32, 3)
    start, end = shown["lidar_to_world"][0], shown["lidar_to_world"][2]
    moved_m = np.linalg.norm(end[:3, 3] - start[:3, 3])
    assert 2.0 < moved_m < 3.5
    rows = run.rows("curve")
    assert {row["sensor"] for row in rows} == {"lidar"}, "nobody has a true image of such a camera"
    assert all(np.isfinite(row["value"]) for row in rows if row["metric"] == "hit_accuracy")


def _held_out_errors(rows: list[dict]) -> dict[tuple[str, str], float]:
    """Protocol and metric to the trained model's value of the one held-out frame."""
    mine = [row for row in rows if (row["recipe"], row["region"], row["split"]) == ("smoke", "all", "test")]
    return {(row["protocol"], row["metric"]): row["value"] for row in mine}


def test_a_data_set_written_as_a_drive_is_trained_again(run: Run, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh, "poisson_mesh", _missing)
        folder = render_view(
            run.plan.scene, {"name": "again", "shift_m": [0.0, 0.5, 0.0], "exports": ["kitti360", "bin"]},
            run.plan.store.home, out=tmp_path / "made", recipe=SMOKE, progress=lambda line: None,
        )  # fmt: skip
    manifest = json.loads((folder / "manifest.json").read_text())
    assert file_checksums(folder, frozenset({"manifest.json"})) == manifest["checksums"]
    entry = SceneEntry(
        name="second", root=folder / "kitti360", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        test_frames=(2,),
    )  # fmt: skip
    again = plan_run(entry, tmp_path / "home", recipe=SMOKE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_metrics, "load_lpips", lambda: None)
        patch.setattr(mesh, "poisson_mesh", _missing)
        for stage in STAGES:
            outcome = run_named_stage(stage, again, lambda line: None)
            assert all(check.passed for check in outcome.checks if check.blocking), outcome.checks
    rows = read_rows(again.store.path("frames") / "frames.parquet")
    ingested = read_arrays(again.store.path("sweeps") / "returns.zarr")
    for k, scan in enumerate(manifest["scans"]):
        assert rows[k]["pose_valid"] and rows[k]["scan_valid"], rows[k]["reason"]
        assert np.allclose(rows[k]["lidar_to_world"], scan["lidar_to_world"], atol=1e-8)
        points = np.fromfile(folder / scan["files"]["bin"], "<f4").reshape(-1, 4)
        own = slice(ingested["offsets"][k], ingested["offsets"][k + 1])
        assert (ingested["points_m"][own] == points[:, :3]).all()
    second = read_rows(again.store.path("scene_metrics/smoke/0") / "metrics.parquet")
    first_errors, errors = _held_out_errors(run.rows("test")), _held_out_errors(second)
    for key, least in ((("lidar4d_scan", "f_score"), -0.1), (("image", "image_psnr_db"), -3.0)):
        assert errors[key] - first_errors[key] > least, (key, first_errors[key], errors[key])
    images = read_arrays(again.store.path("undistorted") / "images.zarr", "image_00_camera_to_world")
    made = [row["camera_to_world"] for row in manifest["images"]]
    assert np.allclose(images["image_00_camera_to_world"].reshape(4, 16), made, atol=1e-8)
    depth = cv2.imread(str(folder / manifest["images"][0]["depth"]), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16 and depth.size == manifest["images"][0]["pixels"] and depth.any()
    with pytest.raises(DataError, match=r"expected no .*made, or an empty folder"):
        render_view(run.plan.scene, {}, run.plan.store.home, out=folder, progress=lambda line: None)
    inside = run.plan.scene.root / "data_3d_raw/made"
    with pytest.raises(DataError, match=r"outside of the drive, found it in .*data_3d_raw"):
        render_view(run.plan.scene, {}, run.plan.store.home, out=inside, progress=lambda line: None)


def test_a_view_without_any_return_is_said_to_be_empty(run: Run, tmp_path: Path) -> None:
    said: list[str] = []
    for name, shift_m in (("far", [0.0, 900.0, 0.0]), ("near", [0.0, 0.5, 0.0])):
        keys = {"name": name, "shift_m": shift_m, "frames": [1], "cameras": []}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mesh, "poisson_mesh", _missing)
            folder = render_view(
                run.plan.scene, keys, run.plan.store.home, out=tmp_path / name, recipe=SMOKE,
                progress=said.append,
            )  # fmt: skip
        manifest = json.loads((folder / "manifest.json").read_text())
        assert (manifest["scans"][0]["returns"] == 0) == (name == "far")
    doubts = [line for line in said if "check" in line]
    assert doubts == ["[tiny] view: check every_scan_has_returns fails: views with an empty scan: ['far']"]


def test_a_lidar_on_its_head_is_named_while_it_is_rendered_and_on_the_card(run: Run, tmp_path: Path) -> None:
    words = "the LiDAR is up to 180 degrees off upright (quaternions are x, y, z, w)"
    for order, is_turned in (("0 0 0 1", False), ("1 0 0 0", True)):
        said: list[str] = []
        path = tmp_path / "path.txt"
        path.write_text(f"0.1 0 0 0 {order}\n0.2 1 0 0 {order}\n")
        keys = {"name": "own", "pose_file": str(path), "times_s": [0.1], "cameras": []}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mesh, "poisson_mesh", _missing)
            folder = render_view(
                run.plan.scene, keys, run.plan.store.home, out=tmp_path / f"turned_{is_turned}", recipe=SMOKE,
                progress=said.append,
            )  # fmt: skip
        assert any(f"view own: {words}" in line for line in said) is is_turned, said
        assert (words in (folder / "card.md").read_text()) is is_turned


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
        assert {row["protocol"] for row in run.rows(view)} == {"raw", "image", "trust"}
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
    novel_views.run(task)
    published = run.plan.store.path("novel_views/smoke/1")
    shutil.move(task.folder, published)
    measuring = _without_world(run, folder / "metrics", (view, unknown), seed=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_metrics, "load_lpips", lambda: None)
        scene_metrics.run(measuring)
    assert [path.parent.name for path in measuring.folder.glob("*/truth.zarr")] == ["second_camera"]
    return published, read_rows(measuring.folder / "metrics.parquet")


def test_a_view_with_recorded_truth_is_measured_by_its_images_alone(
    recorded: tuple[Path, list[dict]],
) -> None:
    published, rows = recorded
    measured = [row for row in rows if row["protocol"] != "trust"]
    mine = [row for row in measured if row["split"] == "second_camera"]
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
    assert not [row for row in measured if row["split"] == "unknown"]


def test_a_view_without_truth_has_a_verdict_on_its_scans_and_says_what_one_on_images_lacks(
    recorded: tuple[Path, list[dict]],
) -> None:
    _, rows = recorded
    said = {(one.view, one.sensor): one for one in verdicts(mean_rows(rows))}
    assert said.keys() >= {("unknown", "lidar"), ("unknown", "image_00"), ("test", "lidar")}
    scans = said["unknown", "lidar"]
    assert scans.trust is not Trust.NOT_KNOWN and np.isfinite(scans.ratio), scans
    # Frame 2 alone is held out: its image against itself would be no band.
    for view in ("test", "unknown"):
        images = said[view, "image_00"]
        assert images.trust is Trust.NOT_KNOWN and "a single image was held out" in images.why, images
    assert np.isfinite(said["unknown", "image_00"].score)


def test_other_sensors_are_compared_with_the_drive_but_not_laser_by_laser(run: Run) -> None:
    rows = [row for row in run.rows("vlp16") if row["protocol"] == PROTOCOL and row["region"] == "all"]
    known = {row["metric"] for row in rows if np.isfinite(row["value"])}
    assert known >= {SCORE, WRONG.name, AWAY.name, DENSITY.name} and LASERS.name not in known


def test_the_path_of_a_few_scans_is_not_measured_and_the_reason_is_said(run: Run) -> None:
    rows = [row for row in run.rows("shift_1m") if row["metric"] == ODOMETRY.name]
    assert [row["region"] for row in rows] == ["all"] and np.isnan(rows[0]["value"])
    said = str(run.outcomes["scene_metrics"].metadata["not_measured_reasons"])
    assert "trust_odometry_m: a path needs 8 or more consecutive scans" in said


def _scores(run: Run, view: Path) -> dict[str, float]:
    """Sensor to the mean score of a stored view."""
    plan = run.plan
    task = Task(
        scene=plan.scene, store=plan.store, config=plan.config, folder=view.parent, progress=lambda line: None
    )
    paths = [run.stored("test", "model"), view]
    ledger = Ledger(facts={"scene": "tiny", "commit": "abc", **method_columns("model", {}, "smoke", 0)})
    for sensor in recorded_sensors(task, paths):
        assert list(measure_trust(view, sensor, ledger))
    rows = [row for row in ledger.rows if (row["metric"], row["region"]) == (SCORE, "all")]
    return {row["sensor"]: row["value"] for row in mean_rows(rows)}


def test_a_view_made_worse_on_purpose_scores_worse(run: Run, tmp_path: Path) -> None:
    sound = _scores(run, run.stored("shift_1m", "model"))
    arrays, attrs = read_arrays(run.stored("shift_1m", "model")), read_attrs(run.stored("shift_1m", "model"))
    ghosts = arrays["points_m"] * np.float32(1.3)
    doubtful = np.clip(arrays["grid_hit"], 0.4, 0.6)
    turned = arrays["image_00_rgb"][:, :, ::-1]
    harms = {
        "ghosts": ({"points_m": ghosts}, "lidar"), "doubt": ({"grid_hit": doubtful}, "lidar"),
        "guesses": ({"grid_support": np.zeros_like(arrays["grid_support"])}, "lidar"),
        "an empty scan": ({"offsets": np.minimum(arrays["offsets"], arrays["offsets"][-2])}, "lidar"),
        "mirror": ({"image_00_rgb": turned}, "image_00"),
    }  # fmt: skip
    for name, (harm, sensor) in harms.items():
        write_arrays(tmp_path / name / "model.zarr", arrays | harm, attrs)
        found = _scores(run, tmp_path / name / "model.zarr")
        assert found[sensor] > 1.05 * sound[sensor], name
        (other,) = found.keys() - {sensor}
        assert found[other] == sound[other], name


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
    assert SCENE_METRICS.reads_truth and not NOVEL_VIEWS.reads_truth
