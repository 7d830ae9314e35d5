import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.writer import write_frame_poses
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_image_times
from nvsf_core.drives.validation import read_drive
from nvsf_core.errors import CheckFailedError, DataError
from nvsf_core.geometry.se3 import pose_from_parts, pose_of_angles
from nvsf_core.recipe.presets import preset
from nvsf_core.stages import flow
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.inputs import scene_frame
from nvsf_core.stages.runner.execution import StagePlace, run_stage
from nvsf_core.stages.runner.stage import Outcome, RunConfig
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows
from tests.conftest import SHARED
from tests.drives.copies import tiny_scene

REAL = SHARED / "data" / "scenes.toml"
FRAMES = range(10, 16)


def drive(root: Path) -> SceneEntry:
    """Six frames, one camera of 64x48, 1 m a frame along x; the LiDAR 2 m above the pose frame's origin."""
    entry = SceneEntry(
        name="tiny",
        root=root,
        sequence="s_sync",
        first_frame=10,
        last_frame=15,
        test_frames=(12,),
        sweep_period_s=0.1,
    )
    layout = DriveLayout(root, entry.sequence)
    for folder in (layout.calibration_dir, layout.scan_path(0).parent, layout.camera_dir("image_00")):
        folder.mkdir(parents=True)
    layout.poses_path.parent.mkdir(parents=True)
    layout.perspective_path.write_text(
        "S_rect_00: 64 48\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: 50 0 31.5 0 0 50 23.5 0 0 0 1 0\n"
    )
    layout.cam_to_pose_path.write_text("image_00: 0 0 1 1 1 0 0 0 0 1 0 -1.5\n")
    layout.cam_to_velo_path.write_text("0 0 1 1 -1 0 0 0 0 -1 0 -0.5\n")
    poses = [f"{frame} 1 0 0 {1000 + frame} 0 -1 0 3700.4 0 0 -1 110.1\n" for frame in FRAMES]
    layout.poses_path.write_text("".join(poses))
    rng = np.random.default_rng(0)
    for frame in FRAMES:
        scan = np.column_stack([rng.uniform(-20, 20, (200, 3)), rng.uniform(0, 1, 200)])
        scan.astype("<f4").tofile(layout.scan_path(frame))
        image = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        cv2.imwrite(str(layout.image_path("image_00", frame)), image)
    return entry


def run(entry: SceneEntry, home: Path) -> Outcome:
    store = SceneStore(home, entry.name)
    config = RunConfig(recipe=preset("quick"))
    place = StagePlace(stage=flow.FRAMES, scene=entry, store=store, config=config, inputs={})
    return run_stage(place, lambda line: None)


def remove_pose(entry: SceneEntry, frame: int) -> None:
    path = DriveLayout(entry.root, entry.sequence).poses_path
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith(f"{frame} ")) + "\n")


def test_a_clean_drive_is_all_usable_and_placed(tmp_path: Path) -> None:
    outcome = run(drive(tmp_path / "d"), tmp_path)
    rows = read_rows(outcome.path / "frames.parquet")
    assert all(check.passed for check in outcome.checks)
    assert [row["split"] for row in rows] == ["train", "train", "test", "train", "train", "train"]
    assert 0 < outcome.previews["path"].stat().st_size < 100_000
    lidar_to_world = np.array(rows[1]["lidar_to_world"]).reshape(4, 4)
    # Pose frame z down, LiDAR z up: the LiDAR's axes are the world's; the camera is 1.5 m up,
    # and the LiDAR 0.5 m above the camera.
    assert np.allclose(lidar_to_world[:3, :3], np.eye(3))
    assert np.allclose(lidar_to_world[:3, 3], [1011.0, 3700.4, 110.1 + 1.5 + 0.5])
    camera = read_rows(outcome.path / "cameras.parquet")[1]
    assert np.allclose(np.array(camera["camera_to_world"]).reshape(4, 4)[:3, 3], [1012.0, 3700.4, 111.6])
    facts = json.loads((outcome.path / "drive.json").read_text())
    scene_to_world = np.array(facts["scene_to_world"]).reshape(4, 4)
    assert np.allclose(scene_to_world, np.array(rows[3]["lidar_to_world"]).reshape(4, 4))
    assert facts["period_assumed"] is True and "clock_origin_s" not in facts
    assert facts["cameras"]["image_00"]["fx"] == 50.0
    assert [row["time_s"] for row in rows] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])


def test_the_scene_is_placed_by_the_drive_alone(tmp_path: Path) -> None:
    def local_poses(entry: SceneEntry, home: Path) -> tuple[np.ndarray, np.ndarray]:
        outcome = run(entry, home)
        scene_to_world = scene_frame(json.loads((outcome.path / "drive.json").read_text()))
        rows = read_rows(outcome.path / "frames.parquet")
        poses = np.array([row["lidar_to_world"] for row in rows]).reshape(-1, 4, 4)
        return np.linalg.inv(scene_to_world) @ poses, scene_to_world

    still, _ = local_poses(drive(tmp_path / "still"), tmp_path / "a")
    entry = drive(tmp_path / "moved")
    path = DriveLayout(entry.root, entry.sequence).poses_path
    poses = np.loadtxt(path)[:, 1:].reshape(-1, 3, 4)
    poses = pose_from_parts(poses[..., :3], poses[..., 3])
    motion = pose_of_angles((0.37, 0.81, 0.2), 127.0, 0.0, 0.0)
    write_frame_poses(path, list(FRAMES), motion @ poses, rows=3)
    moved, scene_to_world = local_poses(entry, tmp_path / "b")
    assert np.allclose(moved, still, atol=1e-6)
    assert np.allclose(scene_to_world[2, :3], [0, 0, 1]) and np.allclose(scene_to_world[:3, 2], [0, 0, 1])


def test_a_frame_without_a_pose_is_invalid_and_never_gets_its_neighbours(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    remove_pose(entry, 13)
    outcome = run(entry, tmp_path)
    row = read_rows(outcome.path / "frames.parquet")[3]
    image = read_rows(outcome.path / "cameras.parquet")[3]
    assert row["frame"] == image["frame"] == 13
    assert row["lidar_to_world"] == image["camera_to_world"] == []
    assert not (row["pose_valid"] or row["scan_valid"] or image["image_valid"])
    assert "no pose" in row["reason"] and "no pose" in image["reason"]
    assert [check.name for check in outcome.checks if not check.passed] == ["all_frames_have_a_pose"]


def test_a_bad_image_does_not_cost_the_frame_its_scan_nor_the_reverse(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    layout = DriveLayout(entry.root, entry.sequence)
    layout.image_path("image_00", 11).write_bytes(b"no picture")
    cv2.imwrite(str(layout.image_path("image_00", 13)), np.zeros((20, 20, 3), np.uint8))
    layout.scan_path(14).write_bytes(b"123")
    layout.scan_path(15).unlink()
    outcome = run(entry, tmp_path)
    scans = {row["frame"]: row for row in read_rows(outcome.path / "frames.parquet")}
    images = {row["frame"]: row for row in read_rows(outcome.path / "cameras.parquet")}
    assert [frame for frame in FRAMES if not scans[frame]["scan_valid"]] == [14, 15]
    assert [frame for frame in FRAMES if not images[frame]["image_valid"]] == [11, 13]
    assert "truncated" in scans[14]["reason"] and "no scan file" in scans[15]["reason"]
    assert "no PNG" in images[11]["reason"] and "wrong size" in images[13]["reason"]
    assert scans[14]["pose_valid"] and scans[11]["reason"] == ""


def test_images_of_another_clock_are_named_though_none_has_a_pose(tmp_path: Path) -> None:
    import_drive(drive(tmp_path / "recorded"), tmp_path / "plain", progress=str)
    layout = PlainLayout(tmp_path / "plain")
    write_image_times(layout, "image_00", {frame: 500.0 + 0.1 * frame for frame in FRAMES})
    (entry,) = load_catalogue([tmp_path / "plain/scenes.toml"], None)
    outcome = run(entry, tmp_path / "home")
    (found,) = [check for check in outcome.checks if check.name == "all_images_are_usable"]
    assert not found.passed and f"{len(FRAMES)} images left out" in found.detail


def test_an_object_that_is_at_two_places_in_a_frame_is_left_out_there_and_named(tmp_path: Path) -> None:
    import_drive(drive(tmp_path / "recorded"), tmp_path / "plain", progress=str)
    of_box = ["frame,object_id,label,dynamic,x,y,z,qx,qy,qz,qw,length,width,height"]
    places = (
        (11, 7, 1010.0),
        (11, 7, 1015.0),
        (12, 7, 1011.0),
        (11, 8, 1020.0),
        (-1, 9, 990.0),
        (-1, 9, 980.0),
        (-1, 6, 970.0),
        (13, 6, 970.0),
    )
    for frame, object_id, x_m in places:
        of_box.append(f"{frame},{object_id},car,{int(frame >= 0)},{x_m},3705,110,0,0,0,1,4,2,1.5")
    (tmp_path / "plain/boxes.csv").write_text("\n".join(of_box))
    (entry,) = load_catalogue([tmp_path / "plain/scenes.toml"], None)
    outcome = run(entry, tmp_path / "home")
    (found,) = [check for check in outcome.checks if check.name == "all_boxes_are_usable"]
    twice = ["object 7 in frame 11: expected one box, found 2"] * 2
    static = "object 6 in every frame (-1): expected no boxes of single frames beside it, found some"
    words = [*twice, static, "object 6 in frame 13: expected one box, found 2"]
    assert not found.passed and found.detail == f"4 boxes left out: {'; '.join(words)}"
    kept = [(row["frame"], row["object_id"]) for row in read_rows(outcome.path / "boxes.parquet")]
    assert sorted(kept) == [(-1, 9), (-1, 9), (11, 8), (12, 7)]


def test_a_static_box_that_is_said_to_move_is_left_out_and_named(tmp_path: Path) -> None:
    write_demo(tmp_path, size=DemoSize.tiny())
    (path,) = (tmp_path / "data_3d_bboxes").rglob("*.xml")
    static = "<timestamp>-1</timestamp>\n  <dynamic>{}</dynamic>"
    path.write_text(path.read_text().replace(static.format(0), static.format(1), 1))
    (words,) = read_drive(tiny_scene(tmp_path), str).boxes_left_out
    assert words.endswith("in every frame (-1): expected a static object, found a dynamic one")


def test_a_lidar_only_drive_passes(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    layout = DriveLayout(entry.root, entry.sequence)
    for frame in FRAMES:
        layout.image_path("image_00", frame).unlink()
    layout.camera_dir("image_00").rmdir()
    layout.perspective_path.unlink()
    outcome = run(entry, tmp_path)
    assert outcome.metadata["usable_scans"] == 6 and outcome.metadata["cameras"] == "none"
    assert read_rows(outcome.path / "cameras.parquet") == []


def test_a_camera_only_drive_passes(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    layout = DriveLayout(entry.root, entry.sequence)
    for frame in FRAMES:
        layout.scan_path(frame).unlink()
    layout.scan_path(0).parent.rmdir()
    layout.cam_to_velo_path.unlink()
    outcome = run(entry, tmp_path)
    rows = read_rows(outcome.path / "frames.parquet")
    assert outcome.metadata["usable_images"] == 6
    assert not any(row["scan_valid"] for row in rows) and all(row["pose_valid"] for row in rows)
    assert np.allclose(np.array(rows[0]["lidar_to_world"]).reshape(4, 4)[:3, :3], np.eye(3))


def test_a_section_with_nothing_usable_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    for frame in FRAMES:
        remove_pose(entry, frame)
    with pytest.raises(DataError, match=r"poses\.txt: no line for any of frames 10\.\.15; correct"):
        run(entry, tmp_path)
    assert not (tmp_path / "tiny" / "frames").exists()


def test_without_a_usable_training_frame_nothing_is_published(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    for frame in FRAMES:
        if frame not in entry.test_frames:
            remove_pose(entry, frame)
    with pytest.raises(CheckFailedError, match="at_least_one_valid_training_frame"):
        run(entry, tmp_path)
    assert not (tmp_path / "tiny" / "frames").exists()


def test_poses_that_contradict_the_cameras_are_reported(tmp_path: Path) -> None:
    entry = drive(tmp_path / "d")
    layout = DriveLayout(entry.root, entry.sequence)
    line = "{} 0 0 1 {} -1 0 0 3700.4 0 -1 0 111.6 0 0 0 1\n"
    layout.cam0_to_world_path.write_text("".join(line.format(f, 1001 + f) for f in FRAMES))
    agreeing = run(entry, tmp_path / "a")
    layout.cam0_to_world_path.write_text("".join(line.format(f, 1001.3 + f) for f in FRAMES))
    contradicting = run(entry, tmp_path / "b")
    name = "cam0_to_world_agrees_with_poses"
    assert [check.passed for check in agreeing.checks if check.name == name] == [True]
    assert [check.passed for check in contradicting.checks if check.name == name] == [False]


@pytest.mark.parametrize(
    ("name", "n_frames", "boxes"), [("k360_street", 32, 0), ("kitti0005_van_cyclist", 30, 61)]
)
def test_the_real_drives_are_all_usable(tmp_path: Path, name: str, n_frames: int, boxes: int) -> None:
    if not REAL.is_file():
        pytest.skip(f"no real data at {REAL}")
    entry = next(entry for entry in load_catalogue([REAL], None) if entry.name == name)
    outcome = run(entry, tmp_path)
    assert all(check.passed for check in outcome.checks), outcome.checks
    assert outcome.metadata["usable_scans"] == outcome.metadata["usable_images"] == n_frames
    assert outcome.metadata["boxes"] == boxes
    first = np.array(read_rows(outcome.path / "frames.parquet")[0]["lidar_to_world"]).reshape(4, 4)
    assert np.allclose(first[:3, 3], [1000.0, 3700.0, 115.0], atol=1e-6)
