import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nvsf_core.errors import StoreError
from nvsf_core.kitti360.catalogue import SceneEntry
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.recipe import preset
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.stages.scene_metrics import STAGE, TABLE_NAME
from nvsf_core.stages.stage import RunConfig, StageOutput, Task
from nvsf_core.stores.arrays import read_arrays, write_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

FRAMES = (10, 11)
N_RETURNS = 3000
Measured = tuple[StageOutput, list[dict[str, Any]]]


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
            "intensity": np.concatenate([part[1] for part in parts] or [np.zeros(0, np.float32)]),
            "laser": np.concatenate([part[2] for part in parts] or [np.zeros(0, np.int16)]),
        },
    )  # fmt: skip


def _image(frame: int) -> np.ndarray:
    return np.random.default_rng(frame).integers(0, 200, (40, 48, 3)).astype(np.uint8)


def _write_images(store: SceneStore) -> None:
    frames = (9, *FRAMES)
    write_arrays(
        store.path("undistorted") / "images.zarr",
        {
            "image_00_rgb": np.stack([_image(frame) for frame in frames]),
            "image_00_valid": np.ones((40, 48), dtype=bool),
            "image_00_frame": np.array(frames),
        },
    )


def _write_prediction(store: SceneStore, name: str, stretch: float, frames: tuple[int, ...]) -> None:
    pano = LinearPano(quirks=True)
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
        attrs |= {"parameters": 1000, "model_mb": 2.5, "train_seconds": 60.0, "peak_memory_mb": 500.0}
    write_arrays(store.path("novel_views/smoke/3/test") / f"{name}.zarr", arrays, attrs)


def _prepare(task: Task, frames: tuple[int, ...]) -> None:
    _write_recording(task.store, frames)
    _write_images(task.store)
    _write_prediction(task.store, "model", 1.001, frames)
    _write_prediction(task.store, "copy_nearest", 1.05, frames)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    task = _task(tmp_path_factory.mktemp("measured"))
    _prepare(task, FRAMES)
    output = STAGE.run(task)
    return output, read_rows(task.folder / TABLE_NAME)


def _value(rows: list[dict[str, Any]], recipe: str, protocol: str, metric: str) -> float:
    wanted = (recipe, protocol, metric, FRAMES[0])
    (row,) = [r for r in rows if (r["recipe"], r["protocol"], r["metric"], r["frame"]) == wanted]
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
    output = STAGE.run(task)
    rows = read_rows(task.folder / TABLE_NAME)
    assert math.isnan(_value(rows, "smoke", "raw", "hit_accuracy"))
    check = next(check for check in output.checks if check.name == "all_metrics_are_finite")
    assert not check.passed
    assert not check.blocking
    assert "laser of 3000 returns is unknown" in check.detail
    assert output.metadata["undefined"] >= 4


def test_a_drive_without_a_lidar_is_measured_by_its_images(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _prepare(task, ())
    STAGE.run(task)
    assert {row["protocol"] for row in read_rows(task.folder / TABLE_NAME)} == {"image"}


def test_a_rendered_frame_that_was_never_recorded_is_an_error(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _write_recording(task.store, (11,))
    _write_images(task.store)
    _write_prediction(task.store, "model", 1.0, FRAMES)
    with pytest.raises(StoreError, match="frame 10"):
        STAGE.run(task)
