"""The tiny demo drive as other formats have it, and what a reader of any format gives."""

from pathlib import Path

import numpy as np

from nvsf_core.demo.drive import DEMO_SEQUENCE
from nvsf_core.drives.drive import AbstractDrive, drive_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.records import BoxRecord, CameraRecord, DataSet, ImageRecord, ScanRecord

FRAMES = 4
PERIOD_S = 0.1


def tiny_scene(root: Path) -> SceneEntry:
    """The demo drive below a root."""
    return SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=FRAMES - 1,
        test_frames=(2,), sweep_period_s=PERIOD_S,
    )  # fmt: skip


def scene_at(root: Path, kind: str, sequence: str = "there", **values: object) -> SceneEntry:
    """All frames of a copy of the drive."""
    given = {"first_frame": 0, "last_frame": FRAMES - 1, "test_frames": (2,), **values}
    return SceneEntry(name="copy", root=root, sequence=sequence, kind=kind, **given)


def data_set(scene: SceneEntry) -> DataSet:
    """A recorded drive as a data set, so that the exports write it."""
    drive = drive_of(scene)
    facts = drive.facts()
    lidar_to_world = np.stack(
        [facts.poses[frame] @ facts.calibration.lidar_to_pose for frame in drive.frames]
    )
    to_lidar = invert_pose(facts.calibration.lidar_to_pose)
    cameras = facts.calibration.cameras
    records = {
        name: CameraRecord(model=one.intrinsics, in_lidar=to_lidar @ one.to_pose)
        for name, one in cameras.items()
    }
    boxes = drive.boxes().boxes

    def scan(index: int) -> ScanRecord:
        rows = drive.read_scan(index).points
        azimuth = np.arctan2(rows[:, 1].astype(np.float64), rows[:, 0])
        turn = np.concatenate([[0], np.cumsum(np.diff(np.mod(azimuth, 2.0 * np.pi)) < -np.pi)])
        return ScanRecord(
            number=index, rows=rows, ring=turn.astype("<u2"),
            offset_s=(-azimuth / (2.0 * np.pi) * PERIOD_S).astype("<f4"),
            support=np.zeros(len(rows), np.uint8),
            stamp_s=index * PERIOD_S, time_s=index * PERIOD_S, lidar_to_world=lidar_to_world[index],
        )  # fmt: skip

    def image(camera: str, index: int) -> ImageRecord:
        model = cameras[camera].intrinsics
        return ImageRecord(
            rgb=drive.read_image(camera, index, model.width, model.height),
            depth_m=np.zeros((model.height, model.width), np.float32),
        )  # fmt: skip

    def labelled(index: int) -> list[BoxRecord]:
        return [
            BoxRecord(
                object_id=one.object_id, label=one.label, is_dynamic=one.dynamic,
                box_to_world=one.box_to_world,
            )
            for one in boxes if one.frame in (index, -1)
        ]  # fmt: skip

    return DataSet(
        name="copy", sequence=scene.sequence, numbers=list(drive.frames),
        stamp_s=PERIOD_S * np.arange(FRAMES), lidar_to_world=lidar_to_world, sweep_period_s=PERIOD_S,
        cameras=records, scan=scan, image=image, boxes=labelled,
    )  # fmt: skip


def lidar_path(drive: AbstractDrive) -> np.ndarray:
    """(n, 4, 4) poses of the LiDAR, from the first one: worlds differ between formats."""
    facts = drive.facts()
    poses = np.stack([facts.poses[frame] @ facts.calibration.lidar_to_pose for frame in drive.frames])
    return invert_pose(poses[:1]) @ poses


def assert_same_drive(found: AbstractDrive, recorded: AbstractDrive, camera: str, path_m: float) -> None:
    """Scans and images are equal, poses and mounting agree to `path_m`, times to a microsecond."""
    there, here = found.facts(), recorded.facts()
    assert np.abs(there.times.time_s - here.times.time_s).max() < 1e-6
    assert np.abs(lidar_path(found) - lidar_path(recorded)).max() < path_m
    model = here.calibration.cameras["image_00"]
    (copy,) = there.calibration.cameras.values()
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert np.isclose(getattr(copy.intrinsics, name), getattr(model.intrinsics, name), atol=1e-6)
    mounts = [
        invert_pose(facts.calibration.lidar_to_pose) @ one.to_pose
        for facts, one in ((there, copy), (here, model))
    ]
    assert np.abs(mounts[0] - mounts[1]).max() < 1e-6
    for frame in recorded.frames:
        assert np.array_equal(found.read_scan(frame).points, recorded.read_scan(frame).points)
        size = model.intrinsics.width, model.intrinsics.height
        assert np.array_equal(
            found.read_image(camera, frame, *size), recorded.read_image("image_00", frame, *size)
        )
