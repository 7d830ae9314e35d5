import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import StoreError
from nvsf_core.geometry.se3 import pose_of_angles
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.recipe.presets import preset
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.runner.stage import RunConfig, StageOutput, Task
from nvsf_core.stages.scene_metrics import TABLE_NAME, run
from nvsf_core.stores.arrays import read_arrays, read_attrs, write_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows, write_rows

FRAMES = (10, 11)
N_RETURNS = 3000
Measured = tuple[StageOutput, list[dict[str, Any]]]
Moving = tuple[StageOutput, list[dict[str, Any]], Path]


def _task(tmp_path: Path) -> Task:
    scene = SceneEntry(
        name="tiny", root=tmp_path, sequence="s", first_frame=9, last_frame=12, test_frames=FRAMES
    )
    folder = tmp_path / "out"
    folder.mkdir()
    return Task(
        scene=scene, store=SceneStore(home=tmp_path / "home", scene="tiny"), folder=folder,
        config=RunConfig(recipe=preset("smoke"), seed=3), progress=lambda line: None,
    )  # fmt: skip


def _returns(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    azimuth, laser = rng.uniform(-3.1, 3.1, N_RETURNS), rng.integers(0, 4, N_RETURNS)
    elevation = np.deg2rad(-3.0 - 5.0 * laser)
    range_m = 12 + 4 * np.cos(2 * azimuth)
    flat = range_m * np.cos(elevation)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)], 1)
    return points.astype(np.float32), rng.random(N_RETURNS).astype(np.float32), laser.astype(np.int16)


def _write_recording(store: SceneStore, frames: tuple[int, ...]) -> None:
    parts = [_returns(frame) for frame in frames]
    points = np.concatenate([part[0] for part in parts] or [np.zeros((0, 3), np.float32)])
    write_arrays(
        store.path("sweeps") / "returns.zarr",
        {
            "frame": np.array(frames, dtype=np.int64), "offsets": np.arange(len(frames) + 1) * N_RETURNS,
            "points_m": points, "range_m": np.linalg.norm(points, axis=1),
            "firings": np.full(len(frames), 2090, np.int32),
            "intensity": np.concatenate([part[1] for part in parts] or [np.zeros(0, np.float32)]),
            "laser": np.concatenate([part[2] for part in parts] or [np.zeros(0, np.int16)]),
        },
    )  # fmt: skip


def _image(frame: int) -> np.ndarray:
    return np.random.default_rng(frame).integers(0, 200, (40, 48, 3)).astype(np.uint8)


def _write_frames(store: SceneStore, *, moving: bool) -> None:
    """Poses, and in the first held-out frame a moving box in front of LiDAR and camera."""
    pose = np.eye(4)
    pose[:3, 3] = (1000.0, 3700.0, 100.0)
    placed = {"pose_valid": True, "lidar_to_world": pose.ravel().tolist()}
    posed = [{"frame": frame, "time_s": 0.1 * (frame - 9), **placed} for frame in (9, *FRAMES)]
    box = np.diag([6.0, 8.0, 6.0, 1.0])
    box[:3, 3] = pose[:3, 3] + (14.0, 0.0, -2.0)
    boxes = [
        {"frame": FRAMES[0], "object_id": 7, "dynamic": moving, "box_to_world": box.ravel().tolist()},
        {"frame": -1, "object_id": 8, "dynamic": False, "box_to_world": box.ravel().tolist()},
    ]
    store.path("frames").mkdir(parents=True)
    write_rows(store.path("frames") / "frames.parquet", posed, list(posed[0]))
    write_rows(store.path("frames") / "boxes.parquet", boxes, list(boxes[0]))


def _write_images(store: SceneStore) -> None:
    frames = (9, *FRAMES)
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = (1000.0, 3700.0, 100.0)
    write_arrays(
        store.path("undistorted") / "images.zarr",
        {
            "image_00_rgb": np.stack([_image(frame) for frame in frames]),
            "image_00_valid": np.ones((40, 48), dtype=bool),
            "image_00_frame": np.array(frames),
            "image_00_time_s": 0.1 * (np.array(frames) - 9),
            "image_00_camera_to_world": np.stack([pose] * 3),
        },
        {"cameras": {"image_00": {"fx": 30, "fy": 30, "cx": 23.5, "cy": 19.5, "width": 48, "height": 40}}},
    )


def _write_prediction(store: SceneStore, name: str, stretch: float, frames: tuple[int, ...]) -> None:
    pano = LinearPano(reference_quirks=True)
    parts = [_returns(frame) for frame in frames]
    scans = [(stretch * part[0]).astype(np.float32) for part in parts]
    panos = [pano.project(scan, part[1]) for scan, part in zip(scans, parts, strict=True)]
    images = np.stack([_image(frame) // 2 if name == "model" else _image(frame) // 8 for frame in FRAMES])
    arrays: dict[str, Any] = {
        "frame": np.array(frames, dtype=np.int64),
        "image_00_rgb": images,
        "image_00_frame": np.array(FRAMES),
        "image_00_render_seconds": np.full(2, 0.25),
    }
    if frames:
        offsets = np.arange(len(frames) + 1) * N_RETURNS
        points = np.concatenate(scans)
        arrays |= {
            "offsets": offsets, "points_m": points,
            "intensity": np.concatenate([part[1] for part in parts]),
            "laser": np.concatenate([part[2] for part in parts]),
            "pano_range_m": np.stack([image[0] for image in panos]),
            "pano_intensity": np.stack([image[1] for image in panos]),
            "pano_hit": np.stack([(image[0] > 0).astype(np.float32) for image in panos]),
            "ray_offsets": offsets, "ray_range_m": np.linalg.norm(points, axis=1),
            "ray_intensity": np.concatenate([part[1] for part in parts]),
            "lidar_render_seconds": np.full(len(frames), 1.5),
        }  # fmt: skip
    attrs: dict[str, Any] = {"cameras": ["image_00"], "method": name}
    if name == "model":
        attrs |= {"parameters": 1000, "model_mb": 2.5}
    arrays |= {
        "train_seconds": np.array([60.0 if name == "model" else math.nan]),
        "peak_memory_mb": np.array([500.0 if name == "model" else math.nan]),
    }
    write_arrays(store.path("novel_views/smoke/3/test") / f"{name}.zarr", arrays, attrs)


def _prepare(task: Task, frames: tuple[int, ...], *, moving: bool = False) -> None:
    _write_frames(task.store, moving=moving)
    _write_recording(task.store, frames)
    _write_images(task.store)
    _write_prediction(task.store, "model", 1.001, frames)
    _write_prediction(task.store, "copy_nearest", 1.05, frames)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    task = _task(tmp_path_factory.mktemp("measured"))
    _prepare(task, FRAMES)
    output = run(task)
    return output, read_rows(task.folder / TABLE_NAME)


def _value(
    rows: list[dict[str, Any]], recipe: str, protocol: str, metric: str, region: str = "all", frame: int = 10
) -> float:
    wanted = (recipe, protocol, metric, region, frame)
    keys = ("recipe", "protocol", "metric", "region", "frame")
    found = [row for row in rows if tuple(row[key] for key in keys) == wanted]
    # The protocol `masked` has the LiDAR's and the camera's rows; no metric is of both.
    (row,) = found
    return float(row["value"])


def test_a_row_for_every_frame_method_and_metric_under_every_protocol(measured: Measured) -> None:
    output, rows = measured
    assert tuple(rows[0]) == COLUMNS
    assert {row["protocol"] for row in rows} == {"lidar4d", "lidar4d_scan", "raw", "image"}
    assert {row["recipe"] for row in rows} == {"smoke", "copy_nearest"}
    assert {row["frame"] for row in rows} == set(FRAMES)
    keys = [(row["recipe"], row["frame"], row["protocol"], row["sensor"], row["metric"]) for row in rows]
    assert len(set(keys)) == len(keys)
    assert output.metadata["rows"] == len(rows)


def test_every_row_tells_who_made_it_and_what_that_cost(measured: Measured) -> None:
    _, rows = measured
    model = next(row for row in rows if row["recipe"] == "smoke")
    assert (model["seed"], model["split"]) == (3, "test")
    assert (model["train_seconds"], model["render_seconds"]) == (60.0, 1.5)
    camera = next(row for row in rows if row["sensor"] == "image_00")
    assert camera["render_seconds"] == 0.25
    baseline = next(row for row in rows if row["recipe"] == "copy_nearest")
    assert math.isnan(baseline["train_seconds"])


def test_the_better_prediction_scores_better_everywhere(measured: Measured) -> None:
    output, rows = measured
    for protocol in ("lidar4d", "lidar4d_scan", "raw"):
        better, worse = (_value(rows, who, protocol, "chamfer_m2") for who in ("smoke", "copy_nearest"))
        assert better < 0.1 * worse
    assert _value(rows, "smoke", "raw", "range_abs_error_median_m") == pytest.approx(0.012, rel=0.1)
    assert _value(rows, "smoke", "raw", "hit_accuracy") == 1.0
    model, copy = (_value(rows, who, "image", "image_psnr_db") for who in ("smoke", "copy_nearest"))
    assert model > copy
    assert output.metadata["smoke/raw/lidar/hit_accuracy"] == 1.0
    assert "smoke" in str(output.metadata["table"])


def test_undefined_values_are_nan_counted_and_explained(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _prepare(task, FRAMES[:1])
    returns = task.store.path("sweeps") / "returns.zarr"
    arrays = read_arrays(returns)
    write_arrays(returns, arrays | {"laser": np.full_like(arrays["laser"], -1)})
    output = run(task)
    rows = read_rows(task.folder / TABLE_NAME)
    assert math.isnan(_value(rows, "smoke", "raw", "hit_accuracy"))
    check = next(check for check in output.checks if check.name == "all_metrics_of_whole_frames_are_finite")
    assert not check.passed
    assert not check.blocking
    assert "laser of 3000 returns is unknown" in check.detail
    assert output.metadata["undefined"] >= 4


def test_a_drive_without_a_lidar_is_measured_by_its_images(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _prepare(task, ())
    run(task)
    rows = read_rows(task.folder / TABLE_NAME)
    assert {row["sensor"] for row in rows} == {"image_00"}
    # Published camera depth is the one camera metric of that protocol.
    assert {row["metric"] for row in rows if row["protocol"] == "lidar4d"} == {"image_depth_rmse_m"}


def test_a_drive_without_intensities_has_no_errors_of_them_and_no_doubt_for_it(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _prepare(task, FRAMES)
    root = task.store.root
    for path in (root / "sweeps/returns.zarr", *root.glob("novel_views/*/*/test/*.zarr")):
        arrays, attrs = read_arrays(path), read_attrs(path)
        shutil.rmtree(path)
        dull = {name: np.zeros_like(array) for name, array in arrays.items() if "intensity" in name}
        write_arrays(path, arrays | dull, attrs)
    output = run(task)
    rows = read_rows(task.folder / TABLE_NAME)
    dull_rows = [row for row in rows if row["metric"].startswith("intensity_")]
    assert len(dull_rows) > 10 and all(math.isnan(row["value"]) for row in dull_rows)
    assert all(math.isfinite(row["value"]) for row in rows if row["metric"].startswith("range_rmse"))
    assert output.metadata["undefined"] == 0 and all(check.passed for check in output.checks)
    assert "raw intensity_rmse: no return of the recorded scan" in str(
        output.metadata["not_measured_reasons"]
    )


def test_a_rendered_frame_that_was_never_recorded_is_an_error(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _write_frames(task.store, moving=False)
    _write_recording(task.store, (11,))
    _write_images(task.store)
    _write_prediction(task.store, "model", 1.0, FRAMES)
    with pytest.raises(StoreError, match="frame 10"):
        run(task)


def test_a_drive_without_moving_boxes_has_no_rows_of_regions_and_says_why(measured: Measured) -> None:
    output, rows = measured
    assert {row["region"] for row in rows} == {"all"}
    assert "no box of a moving object" in str(output.metadata["foreground"])


def test_what_nobody_could_measure_is_nan_on_nothing_and_fails_no_check(measured: Measured) -> None:
    output, rows = measured
    for metric in ("range_lpips_alex", "intensity_lpips_alex", "image_lpips_alex", "image_depth_rmse_m"):
        mine = [row for row in rows if row["metric"] == metric]
        assert mine
        assert all(math.isnan(row["value"]) and row["n_valid"] == 0 for row in mine)
    assert "LPIPS-Alex: no weights at hand" in str(output.metadata["not_measured_reasons"])
    assert "this model stores no camera depth" in str(output.metadata["not_measured_reasons"])
    assert "lpips_alex" not in str(output.metadata["undefined_reasons"])
    assert not any("lpips_alex" in check.detail for check in output.checks)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Moving:
    """A drive with a moving box in the first held-out frame, and a model that stores camera depth."""
    task = _task(tmp_path_factory.mktemp("moving"))
    _prepare(task, FRAMES, moving=True)
    returns = task.store.path("sweeps") / "returns.zarr"
    arrays = read_arrays(returns)
    direction = arrays["points_m"] / arrays["range_m"][:, None]
    rays = {"direction": direction, "origin_m": np.zeros_like(direction)}
    place = pose_of_angles((1000.0, 3700.0, 100.0), 0.0, 0.0, 0.0)
    write_arrays(returns, arrays | rays, {"scene_to_world": place.reshape(-1).tolist()})
    model = task.store.path("novel_views/smoke/3/test") / "model.zarr"
    # The recorded walls lie 8 to 16 m away; a depth of 12 m everywhere is off by less than 4 m.
    stored = read_arrays(model) | {"image_00_range_m": np.full((2, 40, 48), 12.0, np.float16)}
    write_arrays(model, stored, read_attrs(model))
    output = run(task)
    return output, read_rows(task.folder / TABLE_NAME), task.folder


def test_the_error_cloud_is_a_preview_that_fits_into_an_event_log(moving: Moving) -> None:
    output, _, folder = moving
    (name,) = output.previews.values()
    assert 200 < (folder / name).stat().st_size < 100_000
    assert output.metadata["error_cloud_wrong_share"] == 0.0


def test_moving_boxes_give_foreground_and_background_of_their_very_frame(moving: Moving) -> None:
    output, rows, _ = moving
    assert output.metadata["foreground"] == "1 moving objects, by their boxes"
    for region in ("foreground", "background"):
        found = {(row["protocol"], row["sensor"]) for row in rows if row["region"] == region}
        protocols = [(protocol, "lidar") for protocol in ("lidar4d", "lidar4d_scan", "masked")]
        assert found == {*protocols, ("image", "image_00"), ("masked", "image_00")}
        better, worse = (
            _value(rows, who, "masked", "chamfer_m2", region) for who in ("smoke", "copy_nearest")
        )
        assert better < 0.1 * worse
        exact, off = (
            _value(rows, who, "masked", "range_rmse_m", region) for who in ("smoke", "copy_nearest")
        )
        assert exact < 0.1 * off
    inside, outside = (
        [row["n_valid"] for row in rows if row["metric"] == "range_missing" and row["region"] == region]
        for region in ("foreground", "background")
    )
    # The box stands in one frame only; the other has no foreground.
    assert 0 == min(inside) < max(inside) < min(outside)
    for metric in ("chamfer_m2", "range_rmse_m"):
        assert math.isnan(_value(rows, "smoke", "masked", metric, "foreground", frame=11))
    assert not math.isnan(_value(rows, "smoke", "masked", "chamfer_m2", "background", frame=11))


def test_stored_camera_depth_is_measured_against_the_scan_of_its_frame(moving: Moving) -> None:
    _, rows, _ = moving
    ours, published = (
        _value(rows, "smoke", protocol, "image_depth_rmse_m") for protocol in ("image", "lidar4d")
    )
    assert 0.5 < ours < 4.1
    assert 0.0 < published < ours, "zeros of all other pixels are in the published mean"
    assert math.isnan(_value(rows, "copy_nearest", "image", "image_depth_rmse_m"))
