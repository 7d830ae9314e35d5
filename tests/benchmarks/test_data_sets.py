"""The tables on data sets: both generations, the odometry's steps, and what each format costs."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.data_sets import closed_loop, formats, odometry
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.view_entry import EXPORTS
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.runner.run import SceneRun
from nvsf_core.stages.runner.stage import RunConfig
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import write_table


def test_each_page_has_its_marks() -> None:
    text = closed_loop.PAGE.read_text()
    assert formats.PAGE == odometry.PAGE == closed_loop.PAGE
    for name in ("loop", "odometry", "formats"):
        assert text.count(f"<!-- {name} -->") == text.count(f"<!-- end of {name} -->") == 1


def test_errors_of_a_generation_are_means_over_cameras_and_frames() -> None:
    shared = {
        "scene": "a", "split": "test", "region": "all", "recipe": "quick", "seed": 0, "unit": "1",
        "train_seconds": 1.0, "render_seconds": 1.0, "parameters": 1, "model_mb": 1.0, "frame": 3,
    }  # fmt: skip
    image = shared | {"protocol": "image", "metric": "image_psnr_db"}
    rows = [
        image | {"sensor": "image_00", "value": 20.0}, image | {"sensor": "image_02", "value": 23.0},
        image | {"sensor": "image_00", "value": 99.0, "recipe": "reproject"},
        shared
        | {"protocol": "raw", "metric": "range_abs_error_median_m", "sensor": "lidar", "value": 0.0214},
    ]  # fmt: skip
    assert list(closed_loop.cells(rows, "quick")) == ["–", "–", "–", "–", "0.021", "21.5"]
    table = closed_loop.loop_table([["`a`", "recorded", *closed_loop.cells(rows, "quick")]])
    assert "image PSNR dB" in table and "| `a` | recorded | – | – | – | – | 0.021 | 21.5 |" in table


def test_every_format_has_a_row_with_seconds_and_megabytes(tmp_path: Path) -> None:
    store = SceneStore(home=tmp_path, scene="tiny")
    with store.publish("frames") as folder:
        write_table(folder / "frames.parquet", {"frame": [1, 2], "time_s": [0.0, 0.1]})
    with store.publish("evidence") as folder:
        write_table(folder / "moving.parquet", {"object_id": [], "time_s": [], "box_to_world": []})
    count, points = 2, 50
    azimuth = np.tile(np.linspace(3.0, -3.0, points, dtype=np.float32), (count, 1, 1))
    grid = {
        "grid_range_m": np.full_like(azimuth, 5.0), "grid_hit": np.ones_like(azimuth),
        "grid_intensity": np.full_like(azimuth, 0.5), "grid_azimuth_rad": azimuth,
        "grid_elevation_rad": np.zeros_like(azimuth), "grid_support": np.zeros(azimuth.shape, np.uint8),
        "grid_firings": np.full(count, points),
    }  # fmt: skip
    with store.publish("novel_views/quick/0/test") as folder:
        write_arrays(
            folder / "model.zarr",
            {
                "frame": np.array([1, 2]), "time_s": np.array([0.0, 0.1]), "stamp_s": np.array([0.0, 0.1]),
                "lidar_to_world": np.tile(np.eye(4), (count, 1, 1)), "offsets": np.arange(count + 1) * points,
                "points_m": np.random.default_rng(0).uniform(1.0, 9.0, (count * points, 3)).astype("f4"),
                "intensity": np.full(count * points, 0.5, np.float32),
                "lidar_render_seconds": np.array([0.5, 0.7]), **grid,
            },
            {
                "sensor": "HDL-64E", "cameras": [], "sweep_period_s": 0.1, "grid_lasers": [0],
                "camera_models": {}, "camera_in_lidar": {}, "instances": [],
            },
        )  # fmt: skip
    scene = SceneEntry(
        name="tiny", root=tmp_path, sequence="s", first_frame=1, last_frame=2, test_frames=(2,)
    )
    run = SceneRun(scene=scene, store=store, config=RunConfig(recipe=preset("quick")))
    rows = formats.format_rows(run, "test")
    assert rows[0][4:6] == ["(rendering)", "0.60"]
    assert [row[4] for row in rows[1:]] == [f"`{kind}`" for kind in EXPORTS]
    sizes = {row[4]: float(row[6]) for row in rows[1:] if row[6]}
    assert sizes["`bin`"] == pytest.approx((16 + 2 + 4 + 1) * points / 1e6, abs=0.005)
    assert not [path for path in tmp_path.iterdir() if path.name not in ("tiny",)], "nothing is left over"


def test_points_have_the_times_that_the_data_set_says_and_not_those_of_their_azimuths(tmp_path: Path) -> None:
    rows = []
    for number, offset_s in enumerate((-0.05, 0.04)):
        files = {name: f"{name}{number}" for name in ("bin", "time")}
        np.array([[1.0, 2.0, 3.0, 0.5]], "<f4").tofile(tmp_path / files["bin"])
        np.array([offset_s], "<f4").tofile(tmp_path / files["time"])
        rows.append({"files": files, "stamp_s": 0.1 * number, "lidar_to_world": np.eye(4).ravel().tolist()})
    (tmp_path / "manifest.json").write_text(json.dumps({"scans": rows}))
    scans = odometry.read_scans(tmp_path).scans
    assert scans[0][0].tolist() == [[1.0, 2.0, 3.0]]
    np.testing.assert_allclose([fraction[0] for _, fraction in scans], [-0.5, 0.4], rtol=1e-6)


def test_steps_of_synthetic_scans_stand_beside_those_of_recorded_ones() -> None:
    pytest.importorskip("kiss_icp", reason="the extra `odometry` is not installed")
    generator = np.random.default_rng(0)
    left, ahead, up = (generator.uniform(*span, 4000) for span in ((-8, 8), (-30, 30), (-2, 4)))
    wall_m = np.full(4000, 8.0)
    walls_m = np.concatenate(
        [
            np.column_stack(one)
            for one in ((ahead, wall_m, up), (ahead, -wall_m, up), (3.5 * wall_m, left, up))
        ]
    )

    def drive(noise_m: float) -> odometry.Drive:
        poses = np.tile(np.eye(4), (10, 1, 1))
        poses[:, 0, 3] = 0.5 * np.arange(10)
        scans = [walls_m - pose[:3, 3] + generator.normal(0.0, noise_m, walls_m.shape) for pose in poses]
        return odometry.Drive([(scan, np.zeros(len(scan))) for scan in scans], poses)

    rows = list(odometry.step_rows("a", drive(0.01), [("on the path", drive(0.01)), ("worse", drive(0.3))]))
    assert [row[1] for row in rows] == 2 * ["recorded", "on the path", "worse"]
    assert [row[3] for row in rows] == 3 * ["axes turned"] + 3 * ["points reordered"]
    for worse in (rows[2], rows[5]):
        assert float(worse[6].split(" ±")[0]) > odometry.TARGET and worse[7].startswith("✗")
