import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.geometry.se3 import exp_se3, invert_pose, pose_of_angles
from nvsf_core.recipe.presets import preset
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E, VLP_16
from nvsf_core.stages import flow, frames, pano, sweeps
from nvsf_core.stages.inputs import read_sweeps
from nvsf_core.stages.runner.run import run_scene
from nvsf_core.stages.runner.stage import RunConfig, Task
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows, write_rows
from tests.conftest import SHARED

ORIGIN_M = (1000.0, 3700.0, 115.0)
SCENE = pose_of_angles(ORIGIN_M, 0.0, 0.0, 0.0)
PERIOD_S, FRAMES, LASERS, FIRINGS = 0.1, 6, 64, 400
DATA = SHARED / "data"


def _walls_ahead(origin_m, direction):
    """Distance to the nearest of four walls 8 m aside and 60 m along the street, and the ground."""
    distance = np.full(len(origin_m), np.inf)
    for axis, wall_m in ((1, 8.0), (1, -8.0), (0, 60.0), (0, -60.0), (2, -1.73)):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (wall_m - origin_m[:, axis]) / direction[:, axis]
        distance = np.minimum(distance, np.where(t > 0, t, np.inf))
    return distance


def _record(poses, times_s, k, table=HDL_64E):
    """One scan of the walls as a driver records it, each return at its own time; no correction in it."""
    trajectory = Trajectory(times_s, poses, SCENE)
    azimuth, fraction = firing_grid(table, FIRINGS)
    steps = np.rint(azimuth / table.step_rad - table.phase_steps[:, None])
    azimuth = (steps + table.phase_steps[:, None]) * table.step_rad
    laser = np.repeat(np.arange(table.laser_count), FIRINGS)
    origin_s, direction_s = sensor_rays(table, azimuth.ravel(), laser)
    origin_m, direction = trajectory.move_rays(
        origin_s, direction_s, times_s[k] + PERIOD_S * np.tile(fraction, table.laser_count)
    )
    range_m = _walls_ahead(origin_m, direction)
    points = origin_s + range_m[:, None] * direction_s
    turn = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)
    order = np.lexsort((turn, laser))
    order = order[range_m[order] < 75.0]
    return np.column_stack([points[order], np.full(len(order), 0.3)]).astype(np.float32)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive between walls on disk with its published `frames`; frame 3 is held out, frame 4 has no scan."""
    base = tmp_path_factory.mktemp("drive")
    entry = SceneEntry(
        name="walls", root=base / "root", sequence="s", first_frame=0, last_frame=FRAMES - 1, test_frames=(3,)
    )
    start = np.eye(4)
    start[:3, 3] = ORIGIN_M
    poses = start @ exp_se3(np.arange(FRAMES)[:, None] * np.array([1.0, 0, 0, 0, 0, 0.03]))
    times_s = np.arange(FRAMES) * PERIOD_S
    layout = DriveLayout(entry.root, entry.sequence)
    layout.scan_path(0).parent.mkdir(parents=True)
    rows = []
    for k in range(FRAMES):
        _record(poses, times_s, k).tofile(layout.scan_path(k))
        rows.append(
            {
                "frame": k, "time_s": float(times_s[k]), "split": "test" if k == 3 else "train",
                "lidar_to_world": poses[k].ravel().tolist(), "pose_valid": True, "scan_valid": k != 4,
                "reason": "", "checksum": "",
            }
        )  # fmt: skip
    store = SceneStore(home=base / "home", scene="walls")
    facts = {"scene_to_world": SCENE.reshape(-1).tolist(), "sweep_period_s": PERIOD_S, "period_assumed": True}
    with store.publish("frames") as folder:
        write_rows(folder / "frames.parquet", rows, frames.FRAME_COLUMNS)
        (folder / "drive.json").write_text(json.dumps(facts))
    return entry, store


def _task(drive, folder, **changes):
    entry, store = drive
    entry = replace(entry, **changes)
    folder.mkdir()
    config = RunConfig(recipe=preset("smoke"))
    return Task(scene=entry, store=store, config=config, folder=folder, progress=lambda line: None)


def test_every_return_is_a_ray_onto_the_walls(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeps, "SENSOR", _uncorrected())
    output = sweeps.run(_task(drive, tmp_path / "out"))
    # The walls are of one colour.
    assert [c.name for c in output.checks if not c.passed] == ["intensities_are_recorded"], output.checks
    a = read_arrays(tmp_path / "out" / sweeps.ARRAYS_NAME)
    assert a["frame"].tolist() == [0, 1, 2, 3, 5]
    assert (a["firings"] == FIRINGS).all()
    assert a["offsets"][-1] == len(a["points_m"]) == len(a["laser"])
    hit_m = a["origin_m"] + a["range_m"][:, None] * a["direction"]
    walls = np.stack([8.0 - np.abs(hit_m[:, 1]), 60.0 - np.abs(hit_m[:, 0]), hit_m[:, 2] + 1.73])
    assert np.abs(walls).min(axis=0).max() < 2e-4
    dtypes = {name: array.dtype.str for name, array in a.items()}
    assert dtypes["lidar_to_world"] == "<f8"
    assert {dtypes[name] for name in ("points_m", "origin_m", "direction", "range_m")} == {"<f4"}
    assert {dtypes[name] for name in ("laser", "firing")} == {"<i2"}
    assert dtypes["is_own_vehicle"] == "|b1"


def test_without_compensation_the_walls_smear(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeps, "SENSOR", _uncorrected())
    output = sweeps.run(_task(drive, tmp_path / "out", compensate=False))
    assert output.metadata["compensated"] is False
    assert read_attrs(tmp_path / "out" / sweeps.ARRAYS_NAME)["compensated"] is False
    a = read_arrays(tmp_path / "out" / sweeps.ARRAYS_NAME)
    hit_m = a["origin_m"] + a["range_m"][:, None] * a["direction"]
    walls = np.stack([8.0 - np.abs(hit_m[:, 1]), 60.0 - np.abs(hit_m[:, 0]), hit_m[:, 2] + 1.73])
    assert np.quantile(np.abs(walls).min(axis=0), 0.95) > 0.02


def test_the_catalogue_switches_compensation_off_and_a_turn_then_has_one_pose(tiny_catalogue, tmp_path):
    def run(name, line):
        written = tmp_path / f"{name}.toml"
        text = tiny_catalogue.read_text().replace('"drive"', f'"{tiny_catalogue.parent / "drive"}"')
        written.write_text(text.replace('recipe = "smoke"', f'recipe = "smoke"\n{line}'))
        entry = next(entry for entry in load_catalogue([written], None) if entry.name == "tiny")
        stages = [flow.FRAMES, flow.SWEEPS]
        outcomes = run_scene(entry, tmp_path / name, stages=stages, progress=lambda line: None)
        return SceneStore(home=tmp_path / name, scene="tiny"), outcomes[1].fingerprint

    def seen_from_the_pose(store):
        """Where the rays of one turn end, in the frame of the turn's one pose, beside what was recorded."""
        scene = read_sweeps(store)
        a, turn = scene.arrays, scene.returns_of(1)
        local = invert_pose(scene.trajectory.scene_to_world) @ a["lidar_to_world"][1]
        hit_m = a["origin_m"][turn] + a["range_m"][turn, None] * a["direction"][turn]
        back = np.linalg.inv(local)
        seen_m = hit_m @ back[:3, :3].T + back[:3, 3]
        return scene.period_s, np.linalg.norm(seen_m - a["points_m"][turn], axis=1), a["range_m"][turn]

    moved, moved_print = run("moved", "compensate = true")
    still, still_print = run("still", "compensate = false")
    assert moved_print != still_print
    attrs = read_attrs(still.require("sweeps") / sweeps.ARRAYS_NAME)
    assert attrs["compensated"] is False and attrs["sweep_period_s"] == pytest.approx(0.1)
    period_s, off_m, range_m = seen_from_the_pose(still)
    assert period_s == 0.0, "what is trained and rendered stands still during a turn too"
    # Only the sensor's own elevation correction is left: an angle, the same for every return.
    assert (off_m <= range_m * HDL_64E.elevation_correction_rad * 1.01 + 1e-4).all()
    period_s, off_m, _ = seen_from_the_pose(moved)
    assert period_s == pytest.approx(0.1) and off_m.max() > 0.3


def test_the_published_facts_say_how_lasers_were_found(drive, tmp_path):
    output = sweeps.run(_task(drive, tmp_path / "out"))
    attrs = read_attrs(tmp_path / "out" / sweeps.ARRAYS_NAME)
    assert attrs["laser_source"] == "file_order"
    assert "64 turns" in attrs["laser_evidence"]
    assert attrs["sensor"] == "HDL-64E"
    assert attrs["lasers"] == list(range(64))
    assert attrs["elevation_correction_deg"] == pytest.approx(0.205)
    assert output.metadata["sweep_period_assumed"] is True
    assert (tmp_path / "out" / output.previews["scan"]).stat().st_size < 100_000


def test_another_lidar_than_kittis_is_found_unless_one_is_named(drive, tmp_path):
    entry, store = drive
    shutil.copytree(entry.root, tmp_path / "root")
    layout = DriveLayout(tmp_path / "root", entry.sequence)
    poses = np.array([row["lidar_to_world"] for row in _rows(store)]).reshape(-1, 4, 4)
    for k in range(FRAMES):
        _record(poses, PERIOD_S * np.arange(FRAMES), k, VLP_16).tofile(layout.scan_path(k))
    found = sweeps.run(_task(drive, tmp_path / "found", root=tmp_path / "root"))
    attrs = read_attrs(tmp_path / "found" / sweeps.ARRAYS_NAME)
    assert attrs["sensor"] == "found-16"
    assert attrs["laser_evidence"].startswith("not of an HDL-64E, found from the scans: 16 lasers")
    assert _passed(found, "lasers_are_known")
    named = sweeps.run(_task(drive, tmp_path / "named", root=tmp_path / "root", lidar="HDL-64E"))
    assert read_attrs(tmp_path / "named" / sweeps.ARRAYS_NAME)["sensor"] == "HDL-64E"
    assert not _passed(named, "lasers_are_known")


def test_scans_of_no_rotating_lidar_keep_the_assumed_table(drive, tmp_path):
    entry, _ = drive
    shutil.copytree(entry.root, tmp_path / "root")
    rng = np.random.default_rng(0)
    for k in range(FRAMES):
        rows = np.column_stack([rng.normal(0.0, 10.0, (4000, 3)), np.full(4000, 0.5)])
        rows.astype("<f4").tofile(DriveLayout(tmp_path / "root", entry.sequence).scan_path(k))
    output = sweeps.run(_task(drive, tmp_path / "out", root=tmp_path / "root"))
    assert read_attrs(tmp_path / "out" / sweeps.ARRAYS_NAME)["sensor"] == "HDL-64E"
    assert not _passed(output, "lasers_are_known")


def _rows(store):
    return read_rows(store.require("frames") / "frames.parquet")


def _passed(output, name):
    return next(check.passed for check in output.checks if check.name == name)


def test_both_range_images_are_published_with_their_round_trip(drive, tmp_path):
    _, store = drive
    with store.publish("sweeps") as folder:
        sweeps.run(_task(drive, tmp_path / "made"))
        (tmp_path / "made" / sweeps.ARRAYS_NAME).rename(folder / sweeps.ARRAYS_NAME)
    output = pano.run(_task(drive, tmp_path / "out"))
    a = read_arrays(tmp_path / "out" / pano.ARRAYS_NAME)
    assert a["linear_range_m"].shape == a["linear_intensity"].shape == (5, 66, 1030)
    assert a["beam_range_m"].shape == a["beam_intensity"].shape == (5, 64, 1030)
    assert set(np.unique(a["linear_intensity"])) == {np.float32(0), np.float32(0.3)}
    assert output.metadata["beam_round_trip_chamfer_m2"] < output.metadata["linear_round_trip_chamfer_m2"]
    assert [check.name for check in output.checks] == ["beam_grid_beats_linear_grid"]
    assert output.checks[0].passed
    assert not output.checks[0].blocking


def test_a_camera_only_drive_has_no_returns_and_no_range_images(drive, tmp_path):
    entry, _ = drive
    store = SceneStore(home=tmp_path / "home", scene="walls")
    rows = [
        {"frame": 0, "time_s": 0.0, "split": "train", "lidar_to_world": np.eye(4).ravel().tolist(),
         "pose_valid": True, "scan_valid": False, "reason": "no scan", "checksum": ""}
    ]  # fmt: skip
    facts = {"scene_to_world": SCENE.reshape(-1).tolist(), "sweep_period_s": PERIOD_S, "period_assumed": True}
    with store.publish("frames") as folder:
        write_rows(folder / "frames.parquet", rows, frames.FRAME_COLUMNS)
        (folder / "drive.json").write_text(json.dumps(facts))
    with store.publish("sweeps") as folder:
        task = Task(scene=entry, store=store, config=RunConfig(recipe=preset("smoke")), folder=folder,
                    progress=lambda line: None)  # fmt: skip
        assert sweeps.run(task).metadata["returns"] == 0
    a = read_arrays(store.require("sweeps") / sweeps.ARRAYS_NAME)
    assert a["points_m"].shape == (0, 3)
    assert a["offsets"].tolist() == [0]
    (tmp_path / "out").mkdir()
    task = Task(scene=entry, store=store, config=RunConfig(recipe=preset("smoke")),
                folder=tmp_path / "out", progress=lambda line: None)  # fmt: skip
    assert pano.run(task).metadata["scans"] == 0
    assert read_arrays(tmp_path / "out" / pano.ARRAYS_NAME)["linear_range_m"].shape == (0, 66, 1030)


def test_a_real_map_is_thin_with_the_correction_and_thick_without(tmp_path, monkeypatch):
    if not (DATA / "k360_street").is_dir():
        pytest.skip(f"{DATA / 'k360_street'} is not on this machine")
    entry = SceneEntry(
        name="part", root=DATA / "k360_street", sequence="2013_05_28_drive_9001_sync", first_frame=3020,
        last_frame=3027, test_frames=(3026,), sweep_period_s=0.1046, cameras=(),
    )  # fmt: skip
    outcomes = run_scene(
        entry, tmp_path, recipe="smoke", stages=[flow.FRAMES, flow.SWEEPS], progress=lambda line: None
    )
    found = outcomes[1].metadata
    assert found["laser_source"] == "file_order"
    assert 2171 <= found["firings_min"] <= found["firings_max"] <= 2174
    assert found["map_thickness_m"] < 0.014
    assert 100 < found["own_vehicle_returns_per_scan"] < 165
    monkeypatch.setattr(sweeps, "SENSOR", _uncorrected())
    store = SceneStore(home=tmp_path, scene="part")
    plain = sweeps.run(_task((entry, store), tmp_path / "plain"))
    assert plain.metadata["map_thickness_m"] > 1.05 * found["map_thickness_m"]


def _uncorrected():
    """The sensor without the elevation correction: the walls were recorded without the error it mends."""
    return replace(HDL_64E, elevation_correction_rad=0.0)
