"""Broken stores are seen: by the stage's own checks, in a Dagster instance, and on outputs made earlier."""

import json
import shutil
from dataclasses import replace

import dagster as dg
import numpy as np
import pytest

from assets.factory import asset_of
from assets.scenes import key_of, register
from assets.verdicts import CHECK_NAME
from assets.workspace import Workspace
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages import find_scene, plan_run, run_named_stage
from nvsf_core.stages.checks.images import check_images
from nvsf_core.stages.checks.views import check_views
from nvsf_core.stages.flow import NOVEL_VIEWS, SCENE_METRICS
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.stage import Check, NamedCheck, Stage, StageOutput, Task, UnsoundOutputError
from nvsf_core.stores.arrays import read_arrays, read_attrs, write_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import write_rows, write_table

SCENE = "demo"  # of the project's own catalogue: the partitions are known when Dagster loads
LASERS, FIRINGS, SENSOR = 8, 64, "HDL-64E"
RAYS = LASERS * FIRINGS
NO_SUPPORT = np.zeros(0, np.uint8)
OWN = 10
CAMERA, HIGH, WIDE = "image_00", 12, 16
FRAMES, HELD_OUT = (0, 1, 2, 3, 4), 2


def _scan(draws, share=0.9):
    laser = np.repeat(np.arange(LASERS), FIRINGS)
    kept = np.sort(draws.choice(RAYS, int(share * RAYS), replace=False))
    direction = draws.normal(size=(len(kept), 3))
    points = 10.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return {
        "points_m": points.astype(np.float32),
        "laser": laser[kept].astype(np.int16),
        "intensity": draws.uniform(0.0, 1.0, len(kept)).astype(np.float32),
    }


def _recorded(draws):
    """A scan whose first returns are on the own vehicle: a roof mount to the right."""
    scan = _scan(draws)
    own = np.arange(len(scan["laser"])) < OWN
    scan["points_m"][own] = [0.1, -1.9, 0.1]
    return scan | {"is_own_vehicle": own}


def _at(frame):
    """The sensor's pose: a metre forward each frame."""
    pose = np.eye(4)
    pose[0, 3] = frame
    return pose


def _image(draws):
    return draws.integers(0, 256, (HIGH, WIDE, 3), np.uint8)


def _joined(scans):
    offsets = np.concatenate([[0], np.cumsum([len(scan["laser"]) for scan in scans])])
    return {"offsets": offsets} | {name: np.concatenate([s[name] for s in scans]) for name in scans[0]}


@pytest.fixture
def store(tmp_path, monkeypatch):
    """A home with five recorded scans and images, of which one each is held out."""
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    store, draws = SceneStore((tmp_path / "home").resolve(), SCENE), np.random.default_rng(0)
    with store.publish("frames") as folder:
        split = ["test" if frame == HELD_OUT else "train" for frame in FRAMES]
        write_table(folder / "frames.parquet", {"frame": list(FRAMES), "split": split})
    with store.publish("sweeps") as folder:
        times = {"frame": np.array(FRAMES), "time_s": np.arange(5) * 0.1}
        times["firings"] = np.full(5, FIRINGS, np.int32)
        times["lidar_to_world"] = np.stack([_at(frame) for frame in FRAMES])
        arrays = _joined([_recorded(draws) for _ in FRAMES])
        facts = {"sensor": SENSOR, "scene_to_world": np.eye(4).reshape(-1).tolist()}
        write_arrays(folder / "returns.zarr", times | arrays, facts)
    with store.publish("undistorted") as folder:
        images = {f"{CAMERA}_rgb": np.stack([_image(draws) for _ in FRAMES])}
        images |= {f"{CAMERA}_frame": np.array(FRAMES), f"{CAMERA}_valid": np.ones((HIGH, WIDE), np.bool_)}
        write_arrays(folder / "images.zarr", images, {"cameras": {CAMERA: {}}})
    return store


def _view(folder, scan):
    """The model's held-out view as `novel_views` stores it."""
    counts = {"frame": np.array([HELD_OUT]), "time_s": np.array([0.2])}
    counts["lidar_to_world"] = _at(HELD_OUT)[None]
    counts["support"] = np.full(len(scan["laser"]), Support.SEEN, np.uint8)
    counts |= {"train_seconds": np.array([60.0]), "peak_memory_mb": np.array([500.0])}
    along = {"ray_range_m": np.array([10.0, np.inf], np.float32), "ray_intensity": np.zeros(2, np.float32)}
    images = {
        f"{CAMERA}_rgb": _image(np.random.default_rng(5))[None],
        f"{CAMERA}_range_m": np.full((1, HIGH, WIDE), 10.0, np.float16),
        f"{CAMERA}_frame": np.array([HELD_OUT]),
    }
    (folder / "test").mkdir()
    path = folder / "test" / "model.zarr"
    attrs = {"sensor": SENSOR, "split": "test", "cameras": [CAMERA]}
    write_arrays(path, counts | along | images | _joined([scan]), attrs)
    return path


def _change(path, **arrays):
    changed, attrs = read_arrays(path) | arrays, read_attrs(path)
    write_arrays(path, changed, attrs)


def _nothing(path):
    pass


def _nan(path):
    points = read_arrays(path, "points_m")["points_m"]
    points[7, 1] = np.nan
    _change(path, points_m=points)


def _far(path):
    _change(path, points_m=read_arrays(path, "points_m")["points_m"] * 1e3)


def _dropped(path):
    gone = {"points_m": np.zeros((0, 3), np.float32), "laser": np.zeros(0, np.int16)}
    _change(path, **gone, intensity=np.zeros(0, np.float32), offsets=np.array([0, 0]), support=NO_SUPPORT)


def _half_dropped(path):
    a = read_arrays(path, "points_m", "laser", "intensity", "support")
    half = {name: values[: len(values) // 2] for name, values in a.items()}
    _change(path, **half, offsets=np.array([0, len(half["laser"])]))


def _ghosts(path):
    """Some returns lie where the roof mount was two frames before."""
    points = read_arrays(path, "points_m")["points_m"]
    points[:OWN] = [0.1 - 2.0, -1.9, 0.1]
    _change(path, points_m=points)


def _guessed(path):
    support = read_arrays(path, "support")["support"]
    support[: len(support) // 5] = Support.GUESSED
    _change(path, support=support)


def _grey(path):
    _change(path, intensity=np.full_like(read_arrays(path, "intensity")["intensity"], 0.5))


def _shown_as(change):
    """A damage that changes the image."""

    def damage(path):
        name = f"{CAMERA}_rgb"
        _change(path, **{name: change(read_arrays(path, name)[name])})

    return damage


_black = _shown_as(np.zeros_like)
_one_grey = _shown_as(lambda rgb: np.full_like(rgb, 130))
_plain = _shown_as(lambda rgb: 110 + rgb // 8)
_half_black = _shown_as(lambda rgb: rgb * (np.arange(WIDE) < WIDE // 2)[:, None].astype(np.uint8))


def _without_depth(path):
    name = f"{CAMERA}_range_m"
    _change(path, **{name: np.full_like(read_arrays(path, name)[name], np.inf)})


def _views_stage(damage, scan=None):
    """`novel_views` with its own checks; what it renders is a view that was then damaged on disk."""

    def run(task):
        damage(_view(task.folder, scan or _scan(np.random.default_rng(9))))
        return StageOutput()

    # The home holds only what the checks read, not what its size on the disk is estimated by.
    return replace(NOVEL_VIEWS, inputs=(), run=run, estimate_bytes=None)


def _materialize(stage, instance):
    register(instance, [SCENE])
    return dg.materialize(
        [asset_of(stage, [stage])], partition_key=SCENE, resources={"workspace": Workspace(recipe="smoke")},
        instance=instance, raise_on_error=False,
    )  # fmt: skip


def _shown(instance, stage, names):
    """The latest verdict of each check as the UI asks for it: whether it passed, and how severe it is."""
    keys = [dg.AssetCheckKey(key_of(stage), name) for name in names]
    records = instance.event_log_storage.get_latest_asset_check_execution_by_key(keys)
    found = {key.name: record.event.dagster_event.event_specific_data for key, record in records.items()}
    return {name: (one.passed, one.severity.value, one.metadata) for name, one in found.items()}


@pytest.mark.parametrize(
    ("damage", "named", "blocks"),
    [
        (_nan, "stored_views_are_finite", True),
        (_far, "stored_views_lie_within_limits", True),
        (_dropped, "held_out_scans_hold_returns", True),
        (_half_dropped, "hit_rate_is_like_the_training_scans", False),
        (_grey, "intensities_are_like_the_training_scans", False),
        (_ghosts, "views_hold_no_ghosts_of_the_recording_vehicle", False),
        (_guessed, "little_of_a_view_is_guessed", False),
        (_black, "rendered_images_are_not_blank", False),
        (_one_grey, "rendered_images_are_not_blank", False),
        (_plain, "rendered_images_are_not_blank", False),
        (_without_depth, "rendered_images_are_not_blank", False),
        (_half_black, "images_are_like_the_training_images", False),
    ],
)
def test_a_damaged_view_fails_its_check_in_dagster(store, damage, named, blocks):
    names = [one.name for one in NOVEL_VIEWS.named_checks]
    with dg.DagsterInstance.ephemeral() as instance:
        result = _materialize(_views_stage(damage), instance)
        shown = _shown(instance, "novel_views", [CHECK_NAME, *names])
    passed, severity, metadata = shown[named]
    assert (passed, severity) == (False, "ERROR" if blocks else "WARN")
    assert metadata["value"].value > metadata["limit"].value
    assert result.success is not blocks and not shown[CHECK_NAME][0]
    assert store.path("novel_views/smoke/0").is_dir() is not blocks


def test_a_sound_view_passes_all_and_the_record_keeps_value_and_limit(store):
    with dg.DagsterInstance.ephemeral() as instance:
        assert _materialize(_views_stage(_nothing), instance).success
        shown = _shown(instance, "novel_views", [one.name for one in NOVEL_VIEWS.named_checks])
    assert all(passed for passed, _, _ in shown.values()) and len(shown) == len(NOVEL_VIEWS.named_checks)
    record = read_record(store.path("novel_views/smoke/0"))
    assert {check["name"] for check in record["checks"]} == set(shown)
    assert all(check["value"] <= check["limit"] for check in record["checks"])


def test_images_of_a_dark_recording_are_said_to_be_as_dark_as_it(store, tmp_path):
    recorded = store.require("undistorted") / "images.zarr"
    name = f"{CAMERA}_rgb"
    dark = read_arrays(recorded, name)[name] // 32
    _change(recorded, **{name: dark})
    _change(_view(tmp_path, _scan(np.random.default_rng(9))), **{name: dark[:1]})
    run = _run_plan(store)
    task = Task(scene=run.scene, store=store, config=run.config, folder=tmp_path, progress=lambda line: None)
    (check,) = [one for one in check_images(task) if one.name == "rendered_images_are_not_blank"]
    assert "1 of 1 images are blank" in check.detail
    assert "the recording is as dark or plain, from 1." in check.detail


def _run_plan(store):
    return plan_run(find_scene(SCENE), store.home, recipe="smoke")


def test_a_view_on_a_path_of_its_own_is_compared_with_the_scans_of_its_place(store, tmp_path):
    recorded = store.require("sweeps") / "returns.zarr"
    draws = np.random.default_rng(1)
    # More of the rays return where the drive begins than where it ends.
    _change(recorded, **_joined([_scan(draws, share) for share in (0.9, 0.9, 0.9, 0.6, 0.6)]))
    path = _view(tmp_path, _scan(draws, 0.5))
    way = {"path_knot_s": np.array([0.0, 1.0]), "path_to_world": np.stack([_at(9), _at(0)])}
    _change(path, frame=np.array([0]), path_time_s=np.array([0.4]), **way)
    run = _run_plan(store)
    task = Task(scene=run.scene, store=store, config=run.config, folder=tmp_path, progress=lambda line: None)
    (check,) = [one for one in check_views(task) if one.name == "hit_rate_is_like_the_training_scans"]
    assert check.value == pytest.approx(0.4, abs=0.01) and not check.passed


def _row(metric, value, recipe="smoke"):
    words = {"scene": SCENE, "split": "test", "region": "all", "protocol": "raw", "sensor": "lidar"}
    costs = dict.fromkeys(
        ("train_seconds", "render_seconds", "parameters", "model_mb", "peak_memory_mb"), 0.0
    )
    facts = {"frame": HELD_OUT, "unit": "1", "n_valid": 1, "seed": 0, "commit": "abc", "recipe": recipe}
    return words | dict.fromkeys(costs, 0.0) | facts | {"metric": metric, "value": value}


def _metrics_stage(rows):
    def run(task):
        write_rows(task.folder / "metrics.parquet", rows, COLUMNS)
        return StageOutput()

    return replace(SCENE_METRICS, inputs=(), run=run)


@pytest.mark.parametrize(("metric", "value"), [("hit_accuracy", 1.2), ("chamfer_m2", -0.1), ("f_score", -1)])
def test_a_metric_out_of_its_range_is_not_published(store, metric, value):
    run, views = _run_plan(store), _views_stage(_nothing)
    run_named_stage("novel_views", run, str, stages=[views])
    stage = _metrics_stage([_row(metric, value)])
    with pytest.raises(UnsoundOutputError, match=f"metrics_lie_in_their_ranges: 1 of 1 .*{metric}"):
        run_named_stage("scene_metrics", run, str, stages=[stage])
    assert not store.path("scene_metrics/smoke/0").exists()


def test_a_model_worse_than_a_copy_and_darker_scans_are_doubted(store):
    run, views = _run_plan(store), _views_stage(_grey)
    run_named_stage("novel_views", run, str, stages=[views])
    rows = [_row("chamfer_m2", 0.5), _row("chamfer_m2", 0.2, "copy_nearest"), _row("f_score", 0.4)]
    stage = _metrics_stage([*rows, _row("f_score", 0.9, "copy_nearest")])
    outcome = run_named_stage("scene_metrics", run, str, stages=[stage])
    found = {check.name: check for check in outcome.checks}
    assert [name for name, check in found.items() if not check.passed] == [
        "model_is_better_than_copying", "intensities_are_spread_as_recorded",
    ]  # fmt: skip
    assert "worse in 2 of 2" in found["model_is_better_than_copying"].detail


def test_a_camera_worse_than_a_copy_is_doubted_beside_better_scans(store):
    run, views = _run_plan(store), _views_stage(_nothing)
    run_named_stage("novel_views", run, str, stages=[views])
    of_camera = {"protocol": "image", "sensor": "image_00"}
    better = ("chamfer_m2", "range_abs_error_median_m", "range_missing", "intensity_rmse")
    rows = [_row(metric, 0.1) for metric in better] + [_row(metric, 0.2, "copy_nearest") for metric in better]
    rows += [_row("image_psnr_db", 11.8) | of_camera, _row("image_psnr_db", 13.8, "copy_nearest") | of_camera]
    outcome = run_named_stage("scene_metrics", run, str, stages=[_metrics_stage(rows)])
    (check,) = [one for one in outcome.checks if one.name == "model_is_better_than_copying"]
    assert not check.passed and check.value == 1.0
    assert check.detail == (
        "worse in 1 of 5 main numbers: image image_00 image_psnr_db; in most of image_00's (1 of 1)"
    )


def test_a_model_that_gives_nothing_in_a_frame_of_the_copy_is_worse_and_a_copy_so_is_not_better(store):
    run, views = _run_plan(store), _views_stage(_nothing)
    run_named_stage("novel_views", run, str, stages=[views])
    values = {("chamfer_m2", "smoke"): (0.1, np.nan), ("chamfer_m2", "copy_nearest"): (0.2, 4.0)}
    values |= {("range_missing", "smoke"): (0.1, 0.3), ("range_missing", "copy_nearest"): (0.1, np.nan)}
    rows = [
        _row(metric, value, recipe) | {"frame": frame}
        for (metric, recipe), of_frames in values.items()
        for frame, value in enumerate(of_frames)
    ]
    outcome = run_named_stage("scene_metrics", run, str, stages=[_metrics_stage(rows)])
    (check,) = [one for one in outcome.checks if one.name == "model_is_better_than_copying"]
    assert check.detail == "worse in 1 of 2 main numbers: raw lidar chamfer_m2"
    rows = [row | {"value": np.nan} if row["recipe"] == "smoke" else row for row in rows]
    shutil.rmtree(store.path("scene_metrics"))
    outcome = run_named_stage("scene_metrics", run, str, stages=[_metrics_stage(rows)])
    (check,) = [one for one in outcome.checks if one.name == "model_is_better_than_copying"]
    assert "worse in 2 of 2 main numbers" in check.detail


def test_an_output_made_before_its_check_is_judged_and_not_made_again(store):
    run, made = _run_plan(store), []

    def make(task):
        made.append("made")
        return StageOutput(checks=[Check(name="old", passed=True, detail="kept")])

    named = NamedCheck(name="new", description="of files")
    before = Stage(name="pano", group="prepare", inputs=(), description="-", version="1", run=make)
    after = replace(
        before,
        named_checks=(named,),
        check_version="1",
        check=lambda task: [named.outcome(2.0, 1.0, "too many")],
    )
    run_named_stage("pano", run, str, stages=[before])
    outcome = run_named_stage("pano", run, str, stages=[after])
    assert made == ["made"] and outcome.skipped
    assert [(check.name, check.passed) for check in outcome.checks] == [("old", True), ("new", False)]
    kept = json.loads((store.path("pano") / "stage.json").read_text())
    assert kept["check_version"] == "1" and len(list(store.path("pano").iterdir())) == 1


def test_a_published_view_that_was_damaged_is_made_again(store):
    run, stage, said = _run_plan(store), _views_stage(_nothing), []
    folder = run_named_stage("novel_views", run, str, stages=[stage]).path
    _nan(folder / "test" / "model.zarr")
    outcome = run_named_stage("novel_views", run, said.append, stages=[stage])
    assert not outcome.skipped and any("made again" in line and "model.zarr" in line for line in said)
    assert np.isfinite(read_arrays(folder / "test" / "model.zarr")["points_m"]).all()


def test_a_published_view_that_breaks_a_later_law_is_refused_when_judged_again(store):
    run, stage = _run_plan(store), _views_stage(_nan)
    blind = replace(stage, check=None)
    run_named_stage("novel_views", run, str, stages=[blind])
    with pytest.raises(UnsoundOutputError, match=r"not finite: 1 of .* in test/model, points_m"):
        run_named_stage("novel_views", run, str, stages=[replace(stage, check_version="later")])


def test_a_drive_without_lidar_is_not_judged_by_scans(store):
    shutil.rmtree(store.path("sweeps"))
    with store.publish("sweeps") as folder:
        write_arrays(folder / "returns.zarr", {"frame": np.zeros(0, np.int64)}, {"sensor": SENSOR})
    run = _run_plan(store)
    outcome = run_named_stage("novel_views", run, str, stages=[_views_stage(_nothing)])
    found = {check.name: check.detail for check in outcome.checks}
    assert found["hit_rate_is_like_the_training_scans"].startswith("not run: no training scan")
