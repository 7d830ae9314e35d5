"""A small hand-made store of one measured scene, as the stages publish it."""

import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.metrics.table import COLUMNS, UNITS
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.checksums import json_digest
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows, write_rows, write_table
from tests.records import record_of_output

HEIGHT, WIDTH = 66, 1030
_LIDAR = (
    "chamfer_m2", "f_score", "range_rmse_m", "range_psnr_db", "intensity_rmse", "hit_accuracy",
)  # fmt: skip
_RAW = (
    "range_abs_error_median_m", "range_abs_error_p90_m", "range_missing", "intensity_rmse", "hit_accuracy",
)  # fmt: skip
METHODS = ("reproject", "copy_nearest", "mesh")
_ERROR = {"reproject": 0.06, "copy_nearest": 0.15, "mesh": 0.09}
_TRAIN_S = {"quick": 118.0, "reproject": 4.1, "copy_nearest": 0.0, "mesh": 11.0}


def write_street(
    home: Path, scene: str, *, recipe: str = "quick", seed: int = 0, points_every: int = 16
) -> SceneStore:
    """Publish every output that the report reads: a street between two walls.

    Args:
        home: NVSF_HOME.
        scene: Name of the scene.
        recipe: Name of the recipe that the field was trained by.
        seed: Of that training.
        points_every: Of the cells of a range image this one has a point; 1 for a page as large as a real one.
    """
    store = SceneStore(home=home, scene=scene)
    truth_m = _street_range_m(0.0)
    points_m = _points_m(truth_m)[::points_every]
    with store.publish("pano") as folder:
        arrays = {"frame": np.array([4, 7]), "linear_range_m": np.stack([truth_m] * 2)}
        write_arrays(folder / "pano.zarr", arrays)
        _record(folder, 1.1, {"round_trip_chamfer_m2": 0.11})
    with store.publish("sweeps") as folder:
        arrays = {
            "frame": np.array([4, 7]),
            "offsets": np.array([0, 1, 1 + len(points_m)]),
            "points_m": np.concatenate([points_m[:1], points_m]),
            "intensity": np.full(1 + len(points_m), 0.4, np.float32),
            "lidar_to_world": np.stack([np.eye(4)] * 2),
        }
        write_arrays(folder / "returns.zarr", arrays)
        _record(folder, 3.2, {"returns": len(points_m)})
    with store.publish("undistorted") as folder:
        arrays = {"image_00_rgb": np.stack([_picture(0.0)] * 2), "image_00_frame": np.array([4, 7])}
        write_arrays(folder / "images.zarr", arrays)
        _record(folder, 0.8, {})
    with store.publish("evidence") as folder:
        _record(folder, 4.1, {"voxels": 184_223, "moving_objects": 2})
    with store.publish(f"field/{recipe}/{seed}") as folder:
        steps = list(range(0, 1250, 25))
        loss = [2.0 * math.exp(-step / 300.0) + 0.05 + 0.01 * math.sin(step) for step in steps]
        seconds = [step * 0.05 for step in steps]
        curve = {"step": steps, "seconds": seconds, "loss": loss, "depth": [0.6 * v for v in loss]}
        write_table(folder / "curve.parquet", {**curve, "rays_per_s": [9e4] * len(steps)})
        _record(folder, 118.0, {"steps": 1250})
    with store.publish(f"novel_views/{recipe}/{seed}") as folder:
        _write_view(folder, "test", recipe, ("model", *METHODS), points_every)
        _write_view(folder, "shift_1m", recipe, ("model",), points_every)
        _record(folder, 21.0, {}, failed=("scans_look_recorded", "mean returns 98 213 against 104 112"))
    with store.publish(f"scene_metrics/{recipe}/{seed}") as folder:
        write_rows(folder / "metrics.parquet", _rows(scene, recipe, seed), COLUMNS)
        _record(folder, 12.5, {"machine": "a machine of 2 cores"})
    return store


def _record(
    folder: Path, seconds: float, metadata: dict[str, Any], failed: tuple[str, str] | None = None
) -> None:
    checks = [{"name": "some_check", "passed": True, "detail": "fine", "blocking": True}]
    if failed:
        checks.append({"name": failed[0], "passed": False, "detail": failed[1], "blocking": False})
    record = record_of_output(seconds=seconds, metadata=metadata, checks=checks)
    (folder / "stage.json").write_text(json.dumps(record))


@cache
def _street_range_m(noise_m: float) -> np.ndarray:
    azimuth = np.pi - (np.arange(WIDTH) + 0.5) / WIDTH * 2.0 * np.pi
    elevation = np.radians(2.0 - 26.9 * np.arange(HEIGHT) / (HEIGHT - 1))[:, None]
    wall_m = 9.0 / np.maximum(np.abs(np.sin(azimuth)), 1e-3) / np.cos(elevation)
    ground_m = np.where(elevation < -0.01, 1.73 / np.maximum(-np.sin(elevation), 1e-3), np.inf)
    range_m = np.minimum(wall_m, ground_m)
    noisy_m = range_m + np.random.default_rng(0).normal(0.0, 1.0, range_m.shape) * noise_m
    return np.where(range_m < 80.0, noisy_m, 0.0).astype(np.float32)


def _points_m(range_m: np.ndarray) -> np.ndarray:
    azimuth = np.pi - (np.arange(WIDTH) + 0.5) / WIDTH * 2.0 * np.pi
    elevation = np.radians(2.0 - 26.9 * np.arange(HEIGHT) / (HEIGHT - 1))[:, None]
    flat_m = range_m * np.cos(elevation)
    points_m = np.stack(
        [flat_m * np.cos(azimuth), flat_m * np.sin(azimuth), range_m * np.sin(elevation)], axis=-1
    )
    return points_m[range_m > 0.0].astype(np.float32)


def _picture(shift: float) -> np.ndarray:
    rows, columns = np.mgrid[0:94, 0:352]
    red = 120 + 80 * np.sin(columns / 17.0 + shift)
    return np.stack([red, 90 + rows, 200 - rows], axis=-1).clip(0, 255).astype(np.uint8)


def _write_view(folder: Path, view: str, recipe: str, methods: tuple[str, ...], points_every: int) -> None:
    for method in methods:
        error_m = _ERROR.get(method, 0.03)
        range_m = _street_range_m(4.0 * error_m).copy()
        range_m[10:14, 100:140] = 0.0
        range_m[0, 300:330] = 40.0
        points_m = _points_m(range_m)[::points_every]
        arrays = {
            "frame": np.array([7]),
            "time_s": np.array([0.7]),
            "lidar_to_world": np.eye(4)[None],
            "intensity": np.full(len(points_m), 0.4, np.float32),
            "support": np.full(len(points_m), 2, np.uint8),
            "pano_range_m": range_m[None],
            "points_m": points_m,
            "offsets": np.array([0, len(points_m)]),
            "image_00_rgb": _picture(10.0 * error_m)[None],
            "image_00_frame": np.array([7]),
        }
        (folder / view).mkdir(exist_ok=True)
        attrs = {"sensor": "HDL-64E", "cameras": ["image_00"], "method": method}
        write_arrays(folder / view / f"{method}.zarr", arrays, attrs)


def _rows(scene: str, recipe: str, seed: int) -> list[dict[str, Any]]:
    rows = []
    for method in (recipe, *METHODS):
        error = _ERROR.get(method, 0.03)
        is_model = method == recipe
        shared = {
            "scene": scene, "split": "test", "region": "all", "recipe": method, "seed": seed, "n_valid": 100,
            "train_seconds": _TRAIN_S.get(method, 118.0), "parameters": 1_234_567 if is_model else 0,
            "model_mb": 24.5 if is_model else 19.0, "peak_memory_mb": 900.0, "commit": "abc",
        }  # fmt: skip
        wanted = [(p, "lidar", m) for p in ("lidar4d", "lidar4d_scan") for m in _LIDAR]
        wanted += [("raw", "lidar", m) for m in _RAW]
        wanted += [("image", "image_00", m) for m in ("image_psnr_db", "image_ssim")]
        for protocol, sensor, metric in wanted:
            for frame in (4, 7):
                value = 20.0 - 40.0 * error if metric.endswith("_db") else error
                if metric in ("f_score", "hit_accuracy", "image_ssim"):
                    value = 1.0 - error
                if metric == "intensity_rmse" and frame == 4:
                    value = math.nan
                row = {"protocol": protocol, "sensor": sensor, "metric": metric, "frame": frame}
                seconds = 0.4 if sensor == "lidar" else 1.2
                rows.append(
                    {**shared, **row, "value": value, "unit": UNITS[metric], "render_seconds": seconds}
                )
    return rows


def add_view(store: SceneStore, place: str, view: str, shift_m: float) -> None:
    """Give the run at `place` (recipe and seed) errors and records of a view that was asked for.

    Args:
        store: The scene's store, by `write_street`.
        place: Recipe and seed with a stroke between them.
        view: Name of the view.
        shift_m: How far to the left it was asked for, metres; its images are the worse.
    """
    metrics, views = store.path(f"scene_metrics/{place}"), store.path(f"novel_views/{place}")
    rows = read_rows(metrics / "metrics.parquet")
    images = [row for row in rows if row["metric"] == "image_psnr_db"]
    own = [row | {"split": view, "value": row["value"] - shift_m} for row in images]
    write_rows(metrics / "metrics.parquet", [*rows, *own], COLUMNS)
    asked = [{"name": view, "shift_m": [0.0, shift_m, 0.0], "frames": [7]}]
    files = {".": {"model": place + str(asked)}}
    _add_facts(views, {"views": asked}, files)
    inputs = {"frames": "f", "novel_views": json_digest(files)}
    _add_facts(metrics, {"inputs": inputs, "truth": "none"}, {})


def _add_facts(folder: Path, facts: dict[str, Any], files: dict[str, dict[str, str]]) -> None:
    path = folder / "stage.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"facts": facts, "files": files}))
