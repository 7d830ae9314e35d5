"""Writing of the demo drive: simulated scans and images of an analytic street, in KITTI-360's layout."""

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from nvsf_core.demo.cameras import LIDAR_TO_POSE, DemoCamera, demo_camera, render_image
from nvsf_core.demo.lidar import simulate_scan
from nvsf_core.demo.motion import FRAME_PERIOD_S, EgoSpeed
from nvsf_core.demo.street import CAR_SIZE_M
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.kitti360.boxes import STATIC_FRAME, Box
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.scans import write_scan
from nvsf_core.drives.kitti360.writer import (
    write_boxes,
    write_calibration,
    write_frame_poses,
    write_image,
    write_times,
)
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stores.writers import leftovers, temporary_of

_START_S = 1_369_728_000.0
"""2013-05-28 08:00:00, the date in the sequence's name, in seconds from 1970-01-01."""
DEMO_SEQUENCE = "2013_05_28_drive_9900_sync"
"""A number that KITTI-360 does not have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoSize:
    """Size of a demo drive; the street is always the same."""

    frames: int
    """Number of frames, from 0."""
    lasers: tuple[int, ...]
    """Indices of the HDL-64E's lasers, 0 = top."""
    firings: int
    """Firings of each laser in a sweep."""
    cameras: tuple[str, ...]
    """Names of the perspective cameras."""
    width: int
    """Columns of their images."""
    height: int
    """Rows of their images."""
    fisheye_side: int
    """Side of the square image of `image_02`; 0 = no fisheye."""

    @classmethod
    def short(cls) -> Self:
        """Scene `demo`: 16 frames of a HDL-64E at 20 Hz, a camera and a fisheye with small images."""
        return cls(
            frames=16, lasers=tuple(range(64)), firings=1050, cameras=("image_00",),
            width=352, height=94, fisheye_side=176,
        )  # fmt: skip

    @classmethod
    def full(cls) -> Self:
        """Scene `street`: 32 frames of a whole HDL-64E, two cameras and a fisheye."""
        return cls(
            frames=32, lasers=tuple(range(64)), firings=2100, cameras=("image_00", "image_01"),
            width=704, height=188, fisheye_side=350,
        )  # fmt: skip

    @classmethod
    def tiny(cls) -> Self:
        """A drive that is written and read in a second: 4 frames, 8 lasers, one small camera."""
        return cls(
            frames=4, lasers=(4, 10, 16, 22, 28, 36, 46, 56), firings=64, cameras=("image_00",),
            width=64, height=48, fisheye_side=0,
        )  # fmt: skip


def write_demo(
    root: Path,
    *,
    size: DemoSize | None = None,
    seed: int = 0,
    speed: EgoSpeed | None = None,
    traffic: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the demo drive, sequence `DEMO_SEQUENCE`. The same arguments give the same bytes.

    `root` appears only when it is complete.

    Args:
        root: KITTI-360 root to make; it must not exist, or be an empty folder.
        size: Size of the drive; None = `DemoSize.full()`.
        seed: Seed of the street and of all noise.
        speed: Speed of the recording car; None = about 9 m/s.
        traffic: Number of cars that drive in addition to the demo's own, at most 12.
        progress: Called with (frames done, frames) after each frame.

    Raises:
        DataError: `root` exists and is not empty, or cannot be written.
    """
    size = DemoSize.full() if size is None else size
    if _is_taken(root):
        raise DataError(f"expected no {root}, found one; remove it to write the demo drive again")
    for left in leftovers(root.parent):  # of a writer that was killed
        shutil.rmtree(left, ignore_errors=True)
    part = temporary_of(root)
    try:
        layout = DriveLayout(part, DEMO_SEQUENCE)
        world = DemoWorld(seed, speed=speed, traffic=traffic)
        cameras = _cameras(size)
        to_pose = {camera.name: camera.camera_to_pose for camera in cameras}
        cam0_to_lidar = invert_pose(LIDAR_TO_POSE) @ cameras[0].camera_to_pose
        write_calibration(layout, {camera.name: camera.model for camera in cameras}, to_pose, cam0_to_lidar)
        _write_poses(layout, world, cameras[0], size.frames)
        write_times(layout, to_pose, np.arange(size.frames) * FRAME_PERIOD_S, FRAME_PERIOD_S, _START_S)
        write_boxes(layout.boxes_path("train"), _boxes(world, size.frames), 0, size.frames - 1)
        _write_frames(layout, world, cameras, size, progress)
        part.rename(root)
    except OSError as error:
        remedy = "another process wrote it: use that" if _is_taken(root) else "check space and rights"
        raise DataError(f"expected to write the demo drive to {root}, found {error}; {remedy}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _is_taken(root: Path) -> bool:
    return root.exists() and not (root.is_dir() and not any(root.iterdir()))


def _cameras(size: DemoSize) -> list[DemoCamera]:
    cameras = [demo_camera(name, size.width, size.height) for name in size.cameras]
    side = size.fisheye_side
    return [*cameras, demo_camera("image_02", side, side)] if side else cameras


def _write_poses(layout: DriveLayout, world: DemoWorld, camera: DemoCamera, frames: int) -> None:
    pose_to_world = world.lidar_to_world(np.arange(frames) * FRAME_PERIOD_S) @ invert_pose(LIDAR_TO_POSE)
    write_frame_poses(layout.poses_path, range(frames), pose_to_world, rows=3)
    write_frame_poses(layout.cam0_to_world_path, range(frames), pose_to_world @ camera.image_to_pose, rows=4)


def _boxes(world: DemoWorld, frames: int) -> Iterator[Box]:
    """Boxes of moving objects in each frame, at the pose's instant, and of parked cars once."""
    for mover in world.street.movers:
        poses = world.object_to_world(mover.object_id, np.arange(frames) * FRAME_PERIOD_S)
        for frame, pose in enumerate(poses):
            box = _box_to_world(pose, mover.size_m)
            yield Box(
                frame=frame, object_id=mover.object_id, label=mover.label, dynamic=True, box_to_world=box
            )
    for car in world.street.parked:
        box = _box_to_world(world.street_to_world @ car.pose, CAR_SIZE_M)
        yield Box(frame=STATIC_FRAME, object_id=car.object_id, label="car", dynamic=False, box_to_world=box)


def _box_to_world(pose: np.ndarray, size_m: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) unit cube to world, of an object with pose (4, 4) whose origin is on the road."""
    raised = np.diag([*size_m, 1.0])
    raised[2, 3] = 0.5 * size_m[2]
    return pose @ raised


def _write_frames(
    layout: DriveLayout,
    world: DemoWorld,
    cameras: list[DemoCamera],
    size: DemoSize,
    progress: Callable[[int, int], None] | None,
) -> None:
    lasers = np.array(size.lasers)

    def write_frame(frame: int) -> None:
        scan = simulate_scan(world, frame, lasers, size.firings)
        write_scan(layout.scan_path(frame), scan.points_m, scan.intensity)
        for camera in cameras:
            rgb = render_image(world, camera, frame * FRAME_PERIOD_S)
            write_image(layout.image_path(camera.name, frame), rgb)

    # numpy releases the interpreter's lock in long operations, so threads use all cores.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for done, _ in enumerate(pool.map(write_frame, range(size.frames)), start=1):
            if progress is not None:
                progress(done, size.frames)
