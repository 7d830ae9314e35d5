"""The demo's exact truth: what it was recorded from, seen from anywhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.lidar import exact_rays, simulate_scan
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.catalogue import ViewEntry, load_catalogue
from nvsf_core.drives.view_parts import SensorEntry
from nvsf_core.errors import StoreError
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.simulation.view_plan import ViewPlan, mount_pose, table_of
from nvsf_core.stages.runner.run import SceneRun, plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.scoring.demo_truth import DemoTruth, measure_demo_view, read_demo_truth
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stages.views.view import plan_arrays, plan_attrs
from nvsf_core.stores.arrays import read_arrays, read_attrs, write_arrays

LASERS = np.arange(0, 64, 8)
FIRINGS = 120
COSTS = {"recipe": "exact", "seed": 0} | dict.fromkeys(
    ("train_seconds", "parameters", "model_mb", "peak_memory_mb"), 0.0
)


def _truth() -> DemoTruth:
    return DemoTruth(DemoWorld(), "HDL-64E", LASERS, 0.1, 0.0, 0.01)


def _write_exact_view(
    path: Path, view: ViewEntry, time_s: float, error_m: float = 0.0, seen_from_s: float | None = None
) -> None:
    """What a model that knows the world would publish, with every range too long by `error_m`.

    With `seen_from_s` the world stands still at `time_s`, and the car is where it was then.
    """
    table = table_of(view.sensor, HDL_64E)
    lasers = LASERS if view.sensor is None else np.arange(table.laser_count)
    azimuth, fraction = firing_grid(table, FIRINGS)
    theta = azimuth[lasers]
    plan = ViewPlan(view.name, np.array([4]), np.array([time_s]), mount_pose(view))
    if seen_from_s is not None:
        plan = replace(plan, path_time_s=np.array([seen_from_s]), scene_rate=0.0)
    exact = exact_rays(
        DemoWorld(), table, lasers, theta,
        np.broadcast_to(time_s + plan.scene_rate * 0.1 * fraction, theta.shape),
        mount=plan.mount, own_vehicle=view.sensor is None,
        path_to_world=DemoWorld().lidar_to_world(plan.moments_s[0] + 0.1 * fraction),
    )  # fmt: skip
    origin, direction = sensor_rays(table, theta, lasers[:, None])
    known = exact.range_m <= table.max_range_m
    points = origin + direction * np.where(known, exact.range_m + error_m, 0.0)[..., None]
    returned = (exact.chance >= 0.5) & known
    laser = np.broadcast_to(lasers[:, None], theta.shape)[returned]
    grid = {
        "grid_range_m": np.where(known, np.linalg.norm(points, axis=-1), 0.0),
        "grid_hit": np.where(known, exact.chance, 0.0),
        "grid_intensity": exact.intensity,
        "grid_azimuth_rad": np.arctan2(points[..., 1], points[..., 0]),
        "grid_elevation_rad": np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1])),
    }
    # Two columns of padding, as a sweep shorter than its neighbours has.
    padded = {
        name: np.pad(values, ((0, 0), (0, 2)))[None].astype(np.float32) for name, values in grid.items()
    }
    scan = {
        "points_m": points[returned].astype(np.float32),
        "intensity": exact.intensity[returned],
        "laser": laser,
    }
    known_facts = {
        **plan_arrays(plan), "offsets": np.array([0, len(laser)]),
        "lidar_render_seconds": np.array([0.5]), "grid_firings": np.array([theta.shape[1]]),
    }  # fmt: skip
    write_arrays(path, padded | scan | known_facts, plan_attrs(plan))


def _measure(path: Path, view: ViewEntry) -> dict[str, float]:
    return {row["metric"]: row["value"] for row in _rows(path, view) if row["region"] == "all"}


def _rows(path: Path, view: ViewEntry) -> list[dict]:
    ledger = Ledger(facts={"scene": "demo", "commit": "abc", **COSTS})
    assert list(measure_demo_view(path, view, _truth(), ledger))
    assert {(row["split"], row["protocol"], row["frame"]) for row in ledger.rows} == {(view.name, "raw", 4)}
    return ledger.rows


@pytest.mark.parametrize(
    "view",
    [
        ViewEntry(name="shift_1m", shift_m=(0.0, 1.0, 0.0)),
        ViewEntry(name="vlp16", sensor="VLP-16"),
        ViewEntry(name="turned", yaw_deg=20.0),
        ViewEntry(name="short", sensor=SensorEntry(name="own", elevation_deg=(2.0, -9.0), max_range_m=15.0)),
    ],
    ids=lambda view: view.name,
)
def test_who_knows_the_world_is_perfect_at_any_place_and_with_any_sensor(
    tmp_path: Path, view: ViewEntry
) -> None:
    _write_exact_view(tmp_path / "model.zarr", view, time_s=0.45)
    found = _measure(tmp_path / "model.zarr", view)
    assert found["range_abs_error_p90_m"] < 1e-4
    assert found["chamfer_m2"] < 1e-8
    assert found["hit_accuracy"] == found["hit_f_score"] == found["f_score"] == 1.0
    assert found["intensity_rmse"] < 1e-6
    assert found["range_missing"] == 0.0


def test_a_frozen_instant_is_measured_where_things_were_then_from_where_the_car_was_itself(
    tmp_path: Path,
) -> None:
    view = ViewEntry(name="frozen", frames=(4,), frozen_at_s=1.6)
    _write_exact_view(tmp_path / "model.zarr", view, time_s=1.6, seen_from_s=2.4)
    _write_exact_view(tmp_path / "late.zarr", view, time_s=2.4, seen_from_s=2.4)
    found = {
        (row["region"], row["metric"]): row["value"] for row in _rows(tmp_path / "model.zarr", view)
    }  # fmt: skip
    assert found["all", "range_abs_error_p90_m"] < 1e-4 and found["all", "f_score"] == 1.0
    assert found["foreground", "range_abs_error_p90_m"] < 1e-4, "a moving car is seen from there"
    # The same rays with the world of another instant: what is static fits, what moves is elsewhere.
    arrays = read_arrays(tmp_path / "late.zarr") | {"time_s": np.array([1.6])}
    write_arrays(tmp_path / "wrong.zarr", arrays, read_attrs(tmp_path / "model.zarr"))
    wrong = {(row["region"], row["metric"]): row["value"] for row in _rows(tmp_path / "wrong.zarr", view)}
    assert wrong["all", "range_abs_error_median_m"] < 1e-4
    assert wrong["foreground", "range_abs_error_median_m"] > 0.5


def test_rays_that_answer_nothing_at_the_end_of_a_turn_are_no_padding(tmp_path: Path) -> None:
    view = ViewEntry(name="vlp16", sensor="VLP-16")
    _write_exact_view(tmp_path / "model.zarr", view, time_s=0.45)
    arrays = read_arrays(tmp_path / "model.zarr")
    # Without a lever an unanswered ray of a laser starts, and ends, at the centre: all of it is 0.
    for name in ("grid_range_m", "grid_hit", "grid_azimuth_rad"):
        arrays[name][:, :, -12:] = 0.0
    write_arrays(tmp_path / "blind.zarr", arrays, read_attrs(tmp_path / "model.zarr"))
    found = _measure(tmp_path / "blind.zarr", view)
    assert 0.0 < found["range_missing"] < 0.2 and found["range_abs_error_p90_m"] < 1e-4


def test_an_error_of_range_is_found_at_its_size(tmp_path: Path) -> None:
    view = ViewEntry(name="between", times_s=(0.45,))
    _write_exact_view(tmp_path / "model.zarr", view, time_s=0.45, error_m=0.2)
    found = _measure(tmp_path / "model.zarr", view)
    assert found["range_abs_error_median_m"] == pytest.approx(0.2, abs=1e-3)


def test_answers_of_other_rays_are_refused(tmp_path: Path) -> None:
    view = ViewEntry(name="vlp16", sensor="VLP-16")
    _write_exact_view(tmp_path / "model.zarr", view, time_s=0.45)
    with pytest.raises(StoreError, match="novel_views"):
        _measure(tmp_path / "model.zarr", replace(view, sensor="HDL-64E"))


def test_a_copy_has_the_models_azimuths_and_is_measured_all_the_same(tmp_path: Path) -> None:
    view = ViewEntry(name="up_1m", shift_m=(0.0, 0.0, 1.0))
    _write_exact_view(tmp_path / "model.zarr", view, time_s=0.45)
    arrays = read_arrays(tmp_path / "model.zarr")
    # Copied ranges are a nearer scan's: with the lasers' lever arms their points lie beside the model's.
    arrays["grid_range_m"] = np.where(arrays["grid_range_m"] > 0.0, np.float32(3.0), np.float32(0.0))
    for name in ("model", "copy_nearest"):
        write_arrays(tmp_path / "other" / f"{name}.zarr", arrays, read_attrs(tmp_path / "model.zarr"))
    assert _measure(tmp_path / "other" / "copy_nearest.zarr", view)["range_missing"] == 0.0
    with pytest.raises(StoreError, match="novel_views"):
        _measure(tmp_path / "other" / "model.zarr", view)


def test_exact_ranges_are_those_that_a_recorded_scan_was_made_from() -> None:
    scan = simulate_scan(DemoWorld(), 3, LASERS, 60)
    theta = np.mod(np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0]), 2 * np.pi)
    laser = LASERS[scan.laser]
    flat = np.hypot(scan.points_m[:, 0], scan.points_m[:, 1])
    theta = theta - np.arcsin(HDL_64E.horizontal_offset_m[laser] / flat)
    for row in range(len(LASERS)):
        mine = scan.laser == row
        exact = exact_rays(
            DemoWorld(), HDL_64E, LASERS[row : row + 1], theta[mine][None], scan.time_s[mine][None],
            mount=None, own_vehicle=True,
        )  # fmt: skip
        gap_m = np.abs(exact.range_m[0] - scan.true_range_m[mine])
        assert np.median(gap_m) < 2e-3


def test_the_drive_that_the_writer_wrote_is_known_as_its_own_and_others_are_not(
    tiny_catalogue: Path, tmp_path: Path
) -> None:
    entry = next(scene for scene in load_catalogue([tiny_catalogue], None) if scene.name == "tiny")
    run = plan_run(entry, tmp_path, recipe="smoke")
    for stage in ("frames", "sweeps"):
        run_named_stage(stage, run, lambda line: None)
    truth = read_demo_truth(_task(run, tmp_path))
    assert truth is not None
    assert truth.is_of_this_drive
    assert truth.gap_m < 0.03
    other = replace(run, scene=replace(entry, sequence="2013_05_28_drive_0000_sync"))
    assert read_demo_truth(_task(other, tmp_path)) is None


def _task(run: SceneRun, folder: Path) -> Task:
    return Task(
        scene=run.scene, store=run.store, config=run.config, folder=folder, progress=lambda line: None
    )
