"""A drive with cameras alone, or with a LiDAR alone, goes through the whole lineage."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.view_checks import require_views
from nvsf_core.drives.view_parts import CameraEntry
from nvsf_core.errors import DataError
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import FieldSpec, TrainingSpec
from nvsf_core.stages import STAGE_NAMES, Outcome, plan_run, run_named_stage, run_scene
from nvsf_core.stages.benchmark_report import make_benchmark_report
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.views.view import held_out_view
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.checkpoints import load_tensors
from nvsf_core.stores.schemas import CONTRACT, violations
from nvsf_core.stores.tables import read_rows

SPECS = {spec.path: spec for spec in CONTRACT}

VIEWS = (
    ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0), frames=(1,)),
    ViewEntry(name="vlp16", sensor="VLP-16", frames=(1,)),
)
_GRID = FieldSpec(levels=2, log2_table=8)
SMOKE = replace(
    preset("smoke"),
    lidar_field=_GRID,
    lidar_training=TrainingSpec(steps=20, rays=128),
    depth_training=TrainingSpec(steps=20, rays=512),
)
"""The recipe `smoke` with smaller tables, for speed."""
METHODS = ("copy_nearest", "model", "reproject")
SCANNED = ("points", "intensity", "pano", "ray", "grid", "lidar_render")
VIEW_SPEC = SPECS["novel_views/<recipe>/<seed>/<view>/<method>.zarr"]


@dataclass(frozen=True)
class Run:
    """A scene that went through the lineage."""

    home: Path
    outcomes: dict[str, Outcome]
    said: list[str]

    @property
    def root(self) -> Path:
        return self.home / "tiny"

    def arrays(self, view: str, method: str = "model") -> dict[str, np.ndarray]:
        return read_arrays(self.root / "novel_views/smoke/0" / view / f"{method}.zarr")

    def metric_rows(self) -> list[dict[str, object]]:
        return read_rows(self.root / "scene_metrics/smoke/0/metrics.parquet")

    def data_set(self, view: str) -> Path:
        (version,) = (self.root / "dataset" / view).iterdir()
        return version

    def report(self) -> str:
        return make_benchmark_report(self.home, ["tiny"], {}, []).read_text(encoding="utf-8")


def scene_of(root: Path, test_frames: tuple[int, ...] = (2,)) -> SceneEntry:
    return SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        test_frames=test_frames, views=VIEWS,
    )  # fmt: skip


def run_whole(root: Path, home: Path) -> Run:
    said: list[str] = []
    outcomes = run_scene(scene_of(root), home, recipe=SMOKE, progress=said.append)
    return Run(home=home, outcomes={one.stage: one for one in outcomes}, said=said)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("both") / "drive"
    write_demo(root, size=DemoSize.tiny())
    return root


@pytest.fixture(scope="module")
def camera_only(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("camera_only")
    shutil.copytree(drive, folder / "drive", ignore=shutil.ignore_patterns("data_3d_raw", "*_velo.txt"))
    return run_whole(folder / "drive", folder / "home")


@pytest.fixture(scope="module")
def lidar_only(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("lidar_only")
    shutil.copytree(drive, folder / "drive", ignore=shutil.ignore_patterns("data_2d_raw", "perspective.txt"))
    return run_whole(folder / "drive", folder / "home")


def test_a_camera_only_drive_passes_every_stage_and_ends_with_image_rows_alone(camera_only: Run) -> None:
    assert tuple(camera_only.outcomes) == STAGE_NAMES
    rows = camera_only.metric_rows()
    assert {row["sensor"] for row in rows} == {"image_00"}
    assert {row["protocol"] for row in rows if np.isfinite(row["value"])} <= {"image", "masked", "trust"}
    assert {row["recipe"] for row in rows} == {"smoke", "reproject", "copy_nearest"}
    assert camera_only.outcomes["novel_views"].metadata["mesh"] == "not run: this drive has no LiDAR"
    whole = [row for row in rows if (row["protocol"], row["region"]) == ("image", "all")]
    psnr = [row["value"] for row in whole if row["metric"] == "image_psnr_db"]
    assert len(psnr) == 3 and np.isfinite(np.array(psnr, np.float64)).all()


def test_without_lidar_nothing_is_proven_and_only_the_camera_is_trained(camera_only: Run) -> None:
    assert "nothing is proven" in str(camera_only.outcomes["evidence"].metadata["evidence"])
    tensors, facts = load_tensors(camera_only.root / "field/smoke/0/weights.safetensors")
    assert facts["has_lidar"] is False and facts["has_camera"] is True
    assert tensors and all(name.startswith("depth_maps.image_00.") for name in tensors)


def test_a_camera_only_view_holds_poses_and_images_and_no_scan(camera_only: Run) -> None:
    for view, methods in (("test", METHODS), ("shift_1m", ("model",))):
        for method in methods:
            arrays = camera_only.arrays(view, method)
            assert not [
                name for name in arrays if name.startswith(("points", "pano", "ray", "grid", "lidar_r"))
            ]
            assert violations(VIEW_SPEC, arrays) == []
    recorded = read_arrays(camera_only.root / "undistorted/images.zarr", "image_00_camera_to_world")
    shown = camera_only.arrays("test")["image_00_camera_to_world"]
    np.testing.assert_allclose(shown[0], recorded["image_00_camera_to_world"][2], atol=1e-6)
    moved = camera_only.arrays("shift_1m")["image_00_camera_to_world"][0]
    apart = np.linalg.norm(moved[:3, 3] - recorded["image_00_camera_to_world"][1][:3, 3])
    assert apart == pytest.approx(1.0, abs=1e-6)


def test_a_view_of_another_lidar_is_told_of_and_not_made_on_a_camera_only_drive(camera_only: Run) -> None:
    words = "not rendered: this drive has no LiDAR"
    assert camera_only.outcomes["novel_views"].metadata["vlp16"] == words
    assert camera_only.outcomes["dataset"].metadata["vlp16"] == words
    assert f"[tiny] novel_views: vlp16 {words}" in camera_only.said
    assert not (camera_only.root / "novel_views/smoke/0/vlp16").exists()
    assert not (camera_only.root / "dataset/vlp16").exists()


def test_a_camera_only_data_set_holds_pictures_with_their_poses(camera_only: Run) -> None:
    folder = camera_only.data_set("shift_1m")
    assert (folder / "image_00/data_rect/0000000001.png").read_bytes().startswith(b"\x89PNG")
    assert not (folder / "velodyne_points").exists()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["scans"] == [] and len(manifest["images"][0]["camera_to_world"]) == 16
    assert manifest["drawn"]["hits"] == "nothing: no LiDAR"


def test_the_report_of_a_camera_only_drive_has_no_scan_in_it(camera_only: Run) -> None:
    page = camera_only.report()
    assert "Camera image_00, frame 2" in page
    assert "<code>mesh</code>: not run: this drive has no LiDAR" in page
    assert "What the laser scanner sees, unrolled" not in page


def test_the_demos_images_are_judged_in_the_report_and_show_something(
    camera_only: Run, lidar_only: Run
) -> None:
    named_checks = ("rendered_images_are_not_blank", "images_are_like_the_training_images")
    checks = {check.name: check for check in camera_only.outcomes["novel_views"].checks}
    assert [(checks[named].passed, checks[named].limit) for named in named_checks] == [
        (True, 0.0),
        (True, 1.0),
    ]
    assert checks["rendered_images_are_not_blank"].detail.startswith("0 of 2 images are blank; plainest view")
    assert all(named.replace("_", " ") in camera_only.report() for named in named_checks)
    unseen = {check.name: check for check in lidar_only.outcomes["novel_views"].checks}
    assert all(unseen[named].detail.startswith("not run: no rendered image") for named in named_checks)


def test_a_lidar_only_drive_passes_every_stage_and_ends_with_lidar_rows_alone(lidar_only: Run) -> None:
    assert tuple(lidar_only.outcomes) == STAGE_NAMES
    rows = lidar_only.metric_rows()
    assert {row["sensor"] for row in rows} == {"lidar"}
    made = {"mesh"} if "Poisson" in str(lidar_only.outcomes["mesh"].metadata["mesh"]) else set()
    assert {row["recipe"] for row in rows} == {"smoke", "reproject", "copy_nearest", *made}
    tensors, facts = load_tensors(lidar_only.root / "field/smoke/0/weights.safetensors")
    assert facts["has_lidar"] is True and facts["has_camera"] is False
    assert {name.split(".")[0] for name in tensors} == {"lidar", "hits"}


def test_a_lidar_only_view_holds_scans_and_no_image(lidar_only: Run) -> None:
    for view, methods in (("test", METHODS), ("shift_1m", ("model",)), ("vlp16", ("model",))):
        for method in methods:
            arrays = lidar_only.arrays(view, method)
            assert not [name for name in arrays if name.startswith("image_")]
            assert violations(VIEW_SPEC, arrays) == []
    assert read_attrs(lidar_only.root / "novel_views/smoke/0/vlp16/model.zarr")["sensor"] == "VLP-16"


def test_a_lidar_only_data_set_and_report_hold_scans_alone(lidar_only: Run) -> None:
    folder = lidar_only.data_set("shift_1m")
    assert (folder / "velodyne_points/data/0000000001.bin").stat().st_size > 0
    assert not (folder / "image_00").exists()
    page = lidar_only.report()
    assert "What the laser scanner sees, unrolled" in page and "Camera image_" not in page


@pytest.mark.parametrize(("one", "absent"), [("camera_only", "unet."), ("lidar_only", "field.colour.")])
def test_the_papers_field_allocates_one_encoder_on_a_drive_of_one_sensor(
    one: str, absent: str, request: pytest.FixtureRequest
) -> None:
    done: Run = request.getfixturevalue(one)
    scene = scene_of(done.home.parent / "drive")
    recipe = preset("paper_smoke")
    assert isinstance(recipe, PaperRecipe)
    # A pano of eight lasers is nearly empty: a field that learns drops from it renders no return at all.
    recipe = replace(recipe, losses=replace(recipe.losses, raydrop=0.0))
    run = plan_run(scene, done.home, recipe=recipe, seed=3)
    for stage in ("field", "novel_views"):
        run_named_stage(stage, run, lambda line: None)
    tensors, _ = load_tensors(done.root / "field/paper_smoke/3/weights.safetensors")
    assert any(name.startswith("field.encoders.0.") for name in tensors)
    assert not any(name.startswith(("field.encoders.1.", absent)) for name in tensors)


def test_each_sensor_is_asked_for_the_held_out_frames_that_it_recorded(drive: Path, tmp_path: Path) -> None:
    shutil.copytree(drive, tmp_path / "drive")
    layout = DriveLayout(tmp_path / "drive", DEMO_SEQUENCE)
    layout.scan_path(1).write_bytes(layout.scan_path(1).read_bytes()[:-3])
    layout.image_path("image_00", 2).write_bytes(b"no picture")
    scene = scene_of(tmp_path / "drive", test_frames=(1, 2))
    run = plan_run(scene, tmp_path / "home", recipe=SMOKE)
    for stage in ("frames", "sweeps", "undistorted", "evidence"):
        run_named_stage(stage, run, lambda line: None)
    recording = read_recording(run.store)
    view = held_out_view(recording, scene.test_frames)
    assert view is not None and view.sweeps is not None
    assert view.sweeps.frame.tolist() == [2]
    assert view.images["image_00"].frame.tolist() == [1]
    alone = held_out_view(replace(recording, lidar=None), scene.test_frames)
    assert alone is not None and alone.sweeps is None and alone.plan.frame.tolist() == [1]
    assert held_out_view(recording, ()) is None


def test_a_fast_view_is_refused_only_where_sweeps_would_reach_beyond_the_path(
    drive: Path, camera_only: Run
) -> None:
    fast = (ViewEntry(name="fast", speed=5.0),)
    with pytest.raises(DataError, match=r"view fast: .* a sweep goes on for 0\.5 s"):
        require_views(replace(scene_of(drive), views=fast))
    faster = (ViewEntry(name="faster", speed=100.0),)
    with pytest.raises(DataError, match=r"expected a path at least as long, found one of .* lower `speed`"):
        require_views(replace(scene_of(drive), views=faster))
    require_views(replace(scene_of(camera_only.home.parent / "drive"), views=fast))


def test_a_frame_without_a_pose_is_refused_before_anything_is_trained(drive: Path, tmp_path: Path) -> None:
    shutil.copytree(drive, tmp_path / "drive")
    poses = DriveLayout(tmp_path / "drive", DEMO_SEQUENCE).poses_path
    lines = [line for line in poses.read_text().splitlines() if line.split()[0] != "3"]
    poses.write_text("\n".join(lines) + "\n")
    views = (ViewEntry(name="last", frames=(1, 3)),)
    with pytest.raises(DataError, match=r"view last: .*expected frames with a pose, found none for \[3\]"):
        require_views(replace(scene_of(tmp_path / "drive"), views=views))


def test_beams_of_a_recorder_of_unknown_width_are_refused_before_anything_is_trained(drive: Path) -> None:
    views = (ViewEntry(name="wide", footprint=True),)
    require_views(replace(scene_of(drive), views=views))
    with pytest.raises(DataError, match=r"view wide: footprint: the beam width of HDL-32E is not known"):
        require_views(replace(scene_of(drive), views=views, lidar="HDL-32E"))
    with pytest.raises(DataError, match=r"the beam width of a sensor that is found is not known"):
        require_views(replace(scene_of(drive), views=views, lidar="found"))


def test_a_camera_that_no_images_cover_is_refused_before_anything_is_trained(
    drive: Path, tmp_path: Path
) -> None:
    shutil.copytree(drive, tmp_path / "drive")
    calibration = tmp_path / "drive" / "calibration" / "perspective.txt"
    words = next(
        line.split() for line in calibration.read_text().splitlines() if line.startswith("P_rect_00")
    )
    longer = [str(4.0 * float(word)) if k in (1, 6) else word for k, word in enumerate(words)]
    calibration.write_text(calibration.read_text().replace(" ".join(words), " ".join(longer)))
    values = {"xi": 1.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "gamma1": 60.0, "gamma2": 60.0}
    fisheye = tuple((values | {"u0": 69.5, "v0": 69.5}).items())
    own = CameraEntry(name="image_11", like="image_00", width=140, height=140, mei=fisheye)
    views = (ViewEntry(name="own", camera=(own,)),)
    require_views(replace(scene_of(drive), views=views))
    with pytest.raises(DataError, match=r"view own, camera image_11, like image_00: .* 40 images of the rec"):
        require_views(replace(scene_of(tmp_path / "drive"), views=views))
