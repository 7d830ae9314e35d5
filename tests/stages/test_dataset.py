"""A data set is drawn from a seed, written as a driver records, and says what it came from."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.errors import DataError, StoreError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.presets import preset
from nvsf_core.rendering.rendered import Support
from nvsf_core.simulation.raydrop import sharpen_hits
from nvsf_core.simulation.scan import sample_scan
from nvsf_core.stages.exports.manifest import SEAL, damaged_data_set, write_manifest
from nvsf_core.stages.flow import DATASET
from nvsf_core.stages.runner.facts import facts_of, scene_facts, view_facts
from nvsf_core.stages.runner.stage import RunConfig, StageOutput, Task
from nvsf_core.stages.sizes import dataset_bytes
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.file_hashes import FileHashes
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows, write_rows, write_table
from tests.clouds.ply_reader import read_ply
from tests.records import record_of_output

_LASERS, _FIRINGS = 8, 64
_PINHOLE = Pinhole(fx=5.0, fy=5.0, cx=3.5, cy=2.5, width=8, height=6)


def _grid(scans: int) -> dict[str, np.ndarray]:
    # Firing by firing the sensor turns clockwise: azimuth falls, and not from a multiple of 2 pi.
    azimuth = np.broadcast_to(1.0 - np.arange(_FIRINGS) * 2 * np.pi / _FIRINGS, (scans, _LASERS, _FIRINGS))
    elevation = np.broadcast_to(np.linspace(0.05, -0.4, _LASERS)[None, :, None], azimuth.shape)
    range_m = np.full(azimuth.shape, 12.0)
    range_m[:, 0, :] = np.inf
    return {
        "grid_range_m": range_m.astype(np.float32),
        "grid_hit": np.full(azimuth.shape, 0.8, np.float32),
        "grid_intensity": np.full(azimuth.shape, 0.3, np.float32),
        "grid_azimuth_rad": azimuth.astype(np.float32),
        "grid_elevation_rad": elevation.astype(np.float32),
        "grid_support": np.zeros(azimuth.shape, np.uint8),
        "grid_firings": np.full(scans, _FIRINGS),
    }


def _write_view(store: SceneStore, view: str, frames: list[int], arrays: dict[str, np.ndarray]) -> None:
    count = len(frames)
    with store.publish(f"novel_views/quick/0/{view}") as folder:
        write_arrays(
            folder / "model.zarr",
            {
                "frame": np.array(frames),
                "time_s": np.arange(count) * 0.1,
                "stamp_s": np.arange(count) * 0.1,
                "lidar_to_world": np.tile(np.eye(4), (count, 1, 1)),
                "offsets": np.arange(count + 1) * 5,
                "points_m": np.arange(count * 15, dtype=np.float32).reshape(-1, 3),
                "intensity": np.full(count * 5, 0.25, np.float32),
                "image_00_rgb": np.full((count, 6, 8, 3), 90, np.uint8),
                "image_00_frame": np.array(frames),
                "image_00_time_s": np.arange(count) * 0.1,
                "image_00_range_m": np.full((count, 6, 8), 5.0, np.float16),
                "image_00_camera_to_world": np.tile(np.eye(4), (count, 1, 1)),
                **arrays,
            },
            {
                "sensor": "HDL-64E",
                "model_mb": math.nan,
                "sweep_period_s": 0.1,
                "grid_lasers": list(range(_LASERS)),
                "instances": [],
                "camera_models": {"image_00": {"kind": "pinhole", **asdict(_PINHOLE)}},
                "camera_in_lidar": {"image_00": np.eye(4).reshape(-1).tolist()},
            },
        )


def _task(tmp_path: Path, draw_seed: int = 0, exports: tuple[str, ...] = ("bin", "ply")) -> Task:
    store = SceneStore(home=tmp_path, scene="tiny")
    scene = SceneEntry(
        name="tiny", root=tmp_path, sequence="s", first_frame=1, last_frame=4, test_frames=(2,),
        views=(ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0), exports=exports),),
    )  # fmt: skip
    if not store.root.exists():
        with store.publish("frames") as folder:
            write_table(folder / "frames.parquet", {"frame": [1, 2], "checksum": ["aa", "bb"]})
            columns = {"frame": [1, 2], "camera": ["image_00"] * 2, "checksum": ["cc", None]}
            write_table(folder / "cameras.parquet", columns)
            (folder / "drive.json").write_text(json.dumps({"clock_origin_s": 1.75e9}))
        with store.publish("evidence") as folder:
            write_table(folder / "moving.parquet", {"object_id": [], "time_s": [], "box_to_world": []})
        _write_view(store, "test", [2], _grid(1))
        _write_view(store, "shift_1m", [1, 4], _grid(2))
        shared = {
            "scene": "tiny", "split": "test", "protocol": "raw", "region": "all", "sensor": "lidar",
            "unit": "1", "seed": 0, "train_seconds": 3.0, "render_seconds": 0.1, "parameters": 10,
            "model_mb": math.nan,
        }  # fmt: skip
        rows = [
            {**shared, "frame": 2, "metric": "f_score", "value": 0.5, "recipe": "quick"},
            {**shared, "frame": 3, "metric": "f_score", "value": 0.7, "recipe": "quick"},
            {**shared, "frame": 2, "metric": "f_score", "value": 0.1, "recipe": "copy_nearest"},
            {**shared, "frame": 2, "metric": "range_rmse_m", "value": math.nan, "recipe": "quick"},
            {**shared, "frame": 2, "metric": "range_medae_m", "value": math.inf, "recipe": "quick"},
        ]
        with store.publish("scene_metrics/quick/0") as folder:
            write_rows(folder / "metrics.parquet", rows, list(rows[0]))
    folder = tmp_path / "record"
    folder.mkdir(exist_ok=True)
    config = RunConfig(recipe=preset("quick"), draw_seed=draw_seed)
    return Task(scene=scene, store=store, config=config, folder=folder, progress=lambda line: None)


def _run(task: Task) -> tuple[StageOutput, dict[str, Path]]:
    output = DATASET.run(task)
    made = json.loads((task.folder / "versions.json").read_text())
    return output, {entry["view"]: task.store.path(entry["location"]) for entry in made}


def test_every_view_becomes_a_data_set_that_reads_back(tmp_path: Path) -> None:
    output, folders = _run(_task(tmp_path))
    assert all(check.passed for check in output.checks)
    assert sorted(folders) == ["shift_1m", "test"]
    scan = np.fromfile(folders["shift_1m"] / "velodyne_points/data/0000000004.bin", "<f4").reshape(-1, 4)
    points_m, intensity = read_ply(folders["shift_1m"] / "velodyne_points/ply/0000000004.ply")
    np.testing.assert_array_equal(scan, np.column_stack([points_m, intensity]))
    assert (folders["test"] / "image_00/data_rect/0000000002.png").read_bytes().startswith(b"\x89PNG")
    assert all((tmp_path / "record" / name).is_file() for name in output.previews.values())


def test_exports_are_on_the_recordings_own_clock(tmp_path: Path) -> None:
    _, folders = _run(_task(tmp_path, exports=("kitti360",)))
    (path,) = folders["shift_1m"].glob("kitti360/data_3d_raw/*/velodyne_points/timestamps.txt")
    assert path.read_text().splitlines()[1].startswith("2025-06-15 15:06:40.0000")


def _lasers_of(scan: np.ndarray) -> np.ndarray:
    elevation = np.arcsin(scan[:, 2] / np.linalg.norm(scan[:, :3], axis=1))
    laser: np.ndarray = np.abs(elevation[:, None] - np.linspace(0.05, -0.4, _LASERS)).argmin(axis=1)
    return laser


def test_support_lies_beside_each_scan_in_the_order_of_its_points(tmp_path: Path) -> None:
    task = _task(tmp_path)
    by_laser = (np.arange(_LASERS) % 3).astype(np.uint8)
    grid = _grid(2) | {"grid_support": np.tile(by_laser[None, :, None], (2, 1, _FIRINGS))}
    _write_view(task.store, "shift_1m", [1, 4], grid)
    _, folders = _run(task)
    scan = np.fromfile(folders["shift_1m"] / "velodyne_points/data/0000000004.bin", "<f4").reshape(-1, 4)
    support = np.fromfile(folders["shift_1m"] / "velodyne_points/support/0000000004.bin", np.uint8)
    np.testing.assert_array_equal(support, by_laser[_lasers_of(scan)])
    (row,) = [
        row
        for row in json.loads((folders["shift_1m"] / "manifest.json").read_text())["scans"]
        if row["number"] == 4
    ]
    assert row["files"]["support"] == "velodyne_points/support/0000000004.bin"
    assert row["support_seen"] == int((support == Support.SEEN).sum())


def test_a_views_true_images_are_no_part_of_its_data_set(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _, folders = _run(task)
    (view,) = task.scene.views
    known = replace(view, truth=(("image_00", tmp_path / "right"),))
    _, again = _run(replace(task, scene=replace(task.scene, views=(known,))))
    assert again == folders
    assert "right" not in (again["shift_1m"] / "manifest.json").read_text()


def test_what_is_measured_later_comes_into_manifest_and_card_and_no_other_file(
    tmp_path: Path,
) -> None:
    task = _task(tmp_path)
    # Known: it counts as whole.
    (task.store.path("frames") / "stage.json").write_text(json.dumps(record_of_output()))
    _, folders = _run(task)
    folder = folders["shift_1m"]
    (folder / "PINNED").touch()
    (folder / "labels.txt").write_text("a reader's own")
    own = {"manifest.json", "card.json", "card.md"}

    def state() -> tuple[dict[str, bytes], dict[str, tuple[int, int]], int]:
        files = [path for path in folder.rglob("*") if path.is_file()]
        texts = {path.name: path.read_bytes() for path in files if path.name in own}
        others = {str(path): (path.stat().st_ino, path.stat().st_size) for path in files}
        others = {name: found for name, found in others.items() if Path(name).name not in (*own, "PINNED")}
        return texts, others, (folder / "manifest.json").stat().st_mtime_ns

    def measure(**changed: object) -> None:
        table = task.store.path("scene_metrics/quick/0") / "metrics.parquet"
        rows = read_rows(table)
        new = [row | changed for row in rows if row["frame"] == 3]
        write_rows(table, [*(row for row in rows if row["frame"] != 3), *new], list(rows[0]))

    before = state()
    measure(render_seconds=0.7)
    assert _run(task)[1] == folders and state() == before, "seconds are no errors"
    measure(value=0.9)
    _run(task)
    texts, others, made_ns = state()
    assert (others, made_ns) == before[1:] and (folder / "PINNED").is_file()
    assert b"| 0.7 | 2 of 2 |" in texts["card.md"] and b"| 0.6 | 2 of 2 |" in before[0]["card.md"]
    (errors,) = [row for row in json.loads(texts["card.json"])["errors"] if row["metric"] == "f_score"]
    assert errors["value"] == pytest.approx(0.7)
    assert "PINNED" not in texts["manifest.json"].decode()
    (folder / "labels.txt").write_text("more of them")
    assert damaged_data_set(folder) is None, "what a reader puts beside it is none of the data set's"
    manifest = json.loads(texts["manifest.json"])
    bare = {key: value for key, value in manifest.items() if key not in ("field_metrics", "rendering", SEAL)}
    write_manifest(folder, bare)  # as of `nvsf view`
    _run(task)
    again = json.loads((folder / "manifest.json").read_text())
    assert again["field_metrics"] == manifest["field_metrics"] and "sensor" in again["rendering"]


def test_the_manifest_names_sources_poses_and_metrics_in_strict_json(tmp_path: Path) -> None:
    _, folders = _run(_task(tmp_path))

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    text = (folders["shift_1m"] / "manifest.json").read_text()
    manifest = json.loads(text, parse_constant=refuse)
    assert manifest["source_checksums"] == {
        "scan 0000000001": "aa", "scan 0000000002": "bb", "image_00 0000000001": "cc",
    }  # fmt: skip
    assert manifest["recipe"]["identity"] == preset("quick").identity()
    assert manifest["software"]["numpy"] == np.__version__
    assert [scan["nearest_frame"] for scan in manifest["scans"]] == [1, 4]
    assert manifest["scans"][1]["lidar_to_world"] == np.eye(4).reshape(-1).tolist()
    by_name = {row["metric"]: row for row in manifest["field_metrics"]}
    assert by_name["f_score"]["value"] == pytest.approx(0.6)
    assert by_name["range_rmse_m"]["value"] is None
    assert by_name["range_rmse_m"]["n_defined"] == 0
    assert by_name["range_medae_m"]["value"] == "inf", "the error of no return is no undefined one"
    card = json.loads((folders["shift_1m"] / "card.json").read_text(), parse_constant=refuse)
    assert {"card.json", "card.md"} <= set(manifest["checksums"])
    assert card["made_by"]["commit"] == manifest["commit"]
    assert [one["metric"] for one in card["errors"]] == ["f_score"]


def test_the_estimated_size_counts_the_images_of_each_whole_format(tmp_path: Path) -> None:
    def estimate(name: str, *exports: str) -> int:
        return dataset_bytes(_task(tmp_path / name, exports=exports))

    # 2 images of 6 x 8 pixels: 3 bytes a pixel's colours, 4 its depth, beside 40 a return for 16.
    returns_more = int(1.1 * 10 * (16 + 40 + 7)) - int(1.1 * 10 * (16 + 7))
    one = estimate("one", "bin")
    for whole, pixel in (("kitti", 3), ("kitti360", 3), ("nuscenes", 3), ("mcap", 7), ("rosbag2", 7)):
        assert estimate(whole, "bin", whole) == one + returns_more + 2 * 6 * 8 * pixel, whole


def test_another_licence_changes_the_card_and_no_training() -> None:
    entry = SceneEntry(
        name="tiny", root=Path("drive"), sequence="s", first_frame=1, last_frame=4, test_frames=()
    )
    licensed = replace(entry, licence="CC BY 4.0")
    assert scene_facts(licensed) == scene_facts(entry)
    config, inputs, hashes = (
        RunConfig(recipe=preset("quick")),
        dict.fromkeys(DATASET.inputs, ""),
        FileHashes(Path("unused")),
    )
    facts = facts_of(DATASET, licensed, config, inputs, hashes)
    assert facts["licence"] == "CC BY 4.0"
    assert "licence" not in facts_of(DATASET, entry, config, inputs, hashes)
    with pytest.raises(DataError, match="licence: expected a line"):
        replace(entry, licence="two\nlines")


def test_the_same_seed_gives_the_same_bytes_and_another_a_version_beside(tmp_path: Path) -> None:
    name = "velodyne_points/data/0000000001.bin"
    _, first = _run(_task(tmp_path))
    before = (first["shift_1m"] / name).read_bytes()
    _, again = _run(_task(tmp_path))
    assert again == first
    assert (again["shift_1m"] / name).read_bytes() == before
    _, other = _run(_task(tmp_path, draw_seed=7))
    assert other["shift_1m"] != first["shift_1m"]
    assert first["shift_1m"].is_dir()
    assert (other["shift_1m"] / name).read_bytes() != before


def test_two_scans_of_one_data_set_are_drawn_apart(tmp_path: Path) -> None:
    _, folders = _run(_task(tmp_path))
    data = folders["shift_1m"] / "velodyne_points/data"
    assert (data / "0000000001.bin").read_bytes() != (data / "0000000004.bin").read_bytes()


def test_views_that_share_a_nearest_frame_do_not_overwrite_each_other(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _write_view(task.store, "shift_1m", [3, 3], _grid(2))
    _, folders = _run(task)
    assert sorted(path.name for path in (folders["shift_1m"] / "velodyne_points/data").iterdir()) == [
        "0000000000.bin",
        "0000000001.bin",
    ]


def test_a_view_that_is_not_rendered_as_it_is_asked_for_now_is_left_out_and_said(tmp_path: Path) -> None:
    task = _task(tmp_path)
    (asked,) = task.scene.views
    facts = {"views": view_facts(task.scene)}
    record = task.store.path("novel_views/quick/0") / "stage.json"
    record.write_text(json.dumps(record_of_output(facts=facts)))

    def made(*views: ViewEntry) -> tuple[StageOutput, dict[str, Path]]:
        return _run(replace(task, scene=replace(task.scene, views=views)))

    output, folders = made(replace(asked, exports=("pcd",)))
    assert set(folders) == {"test", "shift_1m"}, "formats are written from what is rendered"
    assert all(check.passed for check in output.checks)
    output, folders = made(replace(asked, shift_m=(0.0, -2.0, 0.0)), replace(asked, name="new"))
    assert set(folders) == {"test"}
    assert str(output.metadata["shift_1m"]).startswith("left out: rendered before shift_m changed")
    assert str(output.metadata["new"]).startswith("not rendered yet")
    assert [check.name for check in output.checks if not check.passed] == ["views_are_rendered_as_asked"]


def test_a_nan_in_the_rendering_is_refused_by_name(tmp_path: Path) -> None:
    task = _task(tmp_path)
    grid = _grid(2)
    grid["grid_hit"][0, 0, 0] = np.nan
    _write_view(task.store, "shift_1m", [1, 4], grid)
    with pytest.raises(StoreError, match="grid_hit holds 1 NaN"):
        _run(task)


def test_an_unknown_export_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"exports: expected .* bin, ply, pcd, .*found .*las"):
        _run(_task(tmp_path, exports=("las",)))


def test_a_drawn_scan_is_ordered_as_a_driver_records() -> None:
    grid = {name: array[0] for name, array in _grid(1).items()}
    scan, _ = sample_scan(grid, np.random.default_rng(0))
    range_m = np.linalg.norm(scan[:, :3], axis=1)
    laser = _lasers_of(scan)
    azimuth = np.mod(np.arctan2(scan[:, 1].astype(float), scan[:, 0]), 2 * np.pi)
    assert laser.min() == 1, "a laser that sees nothing returns nothing, whatever its hit probability"
    assert (np.diff(laser) >= 0).all()
    assert all((np.diff(azimuth[laser == index]) > 0).all() for index in range(1, _LASERS))
    assert abs(range_m.mean() - 12.0) < 0.005
    assert 0.01 < range_m.std() < 0.02


def test_sharpening_keeps_the_expected_number_of_hits() -> None:
    probability = np.random.default_rng(2).beta(2.0, 1.0, (16, 400))
    sharp = sharpen_hits(probability)
    assert sharp.sum() == pytest.approx(probability.sum(), rel=1e-6)
    assert np.abs(sharp - 0.5).mean() > np.abs(probability - 0.5).mean()
    np.testing.assert_allclose(sharpen_hits(probability, 1.0), probability, atol=1e-6)
    assert sharpen_hits(np.zeros((2, 3))).max() < 1e-5
    assert sharpen_hits(np.ones((2, 3))).min() > 1.0 - 1e-5


def test_recipe_seed_is_part_of_the_version(tmp_path: Path) -> None:
    task = _task(tmp_path)
    _, first = _run(task)
    task.store.path("novel_views/quick/0").rename(tmp_path / "moved")
    task.store.path("novel_views/quick").joinpath("1").parent.mkdir(exist_ok=True)
    (tmp_path / "moved").rename(task.store.path("novel_views/quick/1"))
    task.store.path("scene_metrics/quick/0").rename(task.store.path("scene_metrics/quick/1"))
    _, second = _run(replace(task, config=replace(task.config, seed=1)))
    assert first["test"].name != second["test"].name
