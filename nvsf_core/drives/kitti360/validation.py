"""Reading and validation of a section of a drive: its frames and images, their poses, and their faults."""

from collections.abc import Callable
from dataclasses import dataclass
from os.path import lexists

import numpy as np

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.kitti360.boxes import Box, read_boxes
from nvsf_core.drives.kitti360.calibration import (
    Calibration,
    read_calibration,
    read_rectified_camera0_to_pose,
)
from nvsf_core.drives.kitti360.images import decode_image, read_image_bytes
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.poses import PoseDisagreement, compare_poses, read_cam0_to_world, read_poses
from nvsf_core.drives.kitti360.scans import parse_scan, read_scan_bytes
from nvsf_core.drives.kitti360.text import checksum_of, require_folder
from nvsf_core.drives.kitti360.timestamps import FrameTimes, frame_times
from nvsf_core.errors import DataError

_FARTHEST_BOX_M = 20_000.0
"""Largest distance of a box from the section's middle. All static boxes of a sequence are read: some km."""
_NO_POSE = "no pose in poses.txt"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRow:
    """One frame of the section."""

    frame: int
    time_s: float
    """Seconds since the section's first frame."""
    split: str
    """`train` or `test`."""
    lidar_to_world: np.ndarray | None
    """(4, 4) float64, or None if the frame has no pose."""
    scan_valid: bool
    """The scan is readable and plausible, and the frame has a pose."""
    reason: str
    """Why scan or pose cannot be used; empty if both can."""
    checksum: str
    """`checksum_of` the scan's file; empty if there is none of a possible size."""
    n_returns: int
    """Number of usable returns."""
    n_dropped: int
    """Number of absurd points that were left out."""

    @property
    def pose_valid(self) -> bool:
        """Whether the frame has a pose."""
        return self.lidar_to_world is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRow:
    """One image of the section."""

    frame: int
    camera: str
    camera_to_world: np.ndarray | None
    """(4, 4) float64 of the stored image (rectified if perspective), or None if the frame has no pose."""
    image_valid: bool
    """The image is readable and of the calibrated size, and its frame has a pose."""
    reason: str
    """Why it cannot be used; empty if it can."""
    checksum: str
    """`checksum_of` the image's file; empty if there is none of a possible size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """A validated section of a drive, without the returns and the pixels."""

    frames: tuple[FrameRow, ...]
    images: tuple[CameraRow, ...]
    boxes: tuple[Box, ...]
    calibration: Calibration
    times: FrameTimes
    scene_origin_m: np.ndarray
    """(3,) float64, world: the LiDAR's position in the middle frame, rounded to 1 m."""
    boxes_left_out: tuple[str, ...]
    """Boxes that were left out, and why."""
    has_scans: bool
    """Whether there is a folder of scans; else the drive is camera-only."""
    disagreement: PoseDisagreement | None
    """Of `poses.txt` and `cam0_to_world.txt`; None if the drive does not have both."""
    notes: tuple[str, ...]
    """What was assumed or left out, and why."""


def read_drive(entry: SceneEntry, progress: Callable[[str], None]) -> Drive:
    """Read and validate the section of a catalogue entry.

    A frame that cannot be used is kept, with the reason; it never gets its neighbour's pose.

    Args:
        entry: The scene.
        progress: Called with a line of text before each frame is read.

    Raises:
        CalibrationError: A calibration file is absent, or a key is missing or damaged.
        DataError: A line of poses or times cannot be read, or no scan or image of the section can be used.
    """
    layout = DriveLayout(entry.root, entry.sequence)
    has_scans = require_folder(layout.velodyne_dir) and require_folder(layout.scan_path(0).parent)
    calibration = read_calibration(layout, entry.cameras, has_scans=has_scans)
    poses = read_poses(layout.poses_path)
    times = frame_times(layout, entry.first_frame, entry.last_frame, entry.sweep_period_s)
    frames, images = [], []
    for index, frame in enumerate(range(entry.first_frame, entry.last_frame + 1)):
        progress(f"reading frame {frame}, {index} of {len(times.time_s)} done")
        pose = poses.get(frame)
        split = "test" if frame in entry.test_frames else "train"
        time_s = float(times.time_s[index])
        frames.append(_frame_row(layout, frame, time_s, split, pose, calibration, has_scans=has_scans))
        images += [_camera_row(layout, name, frame, pose, calibration) for name in calibration.cameras]
    _require_something(layout, frames, images)
    boxes, left_out, box_notes = _read_boxes(layout, entry, _scene_origin_m(frames))
    notes = list(calibration.notes) + box_notes
    if calibration.lidar_is_assumed:
        notes.append("no LiDAR mounting (camera-only drive): lidar_to_world is the pose frame, turned z up")
    return Drive(
        frames=tuple(frames),
        images=tuple(images),
        boxes=tuple(boxes),
        boxes_left_out=tuple(left_out),
        has_scans=has_scans,
        calibration=calibration,
        times=times,
        scene_origin_m=_scene_origin_m(frames),
        disagreement=_disagreement(layout, poses, entry, calibration),
        notes=tuple(notes),
    )


def _frame_row(
    layout: DriveLayout,
    frame: int,
    time_s: float,
    split: str,
    pose: np.ndarray | None,
    calibration: Calibration,
    *,
    has_scans: bool,
) -> FrameRow:
    reasons = [] if pose is not None else [_NO_POSE]
    checksum, n_returns, n_dropped = "", 0, 0
    path = layout.scan_path(frame)
    if not has_scans:
        reasons.append("camera-only drive")
    elif not lexists(path):
        reasons.append(f"no scan file {path.name}")
    else:
        try:
            data = read_scan_bytes(path)
            checksum = checksum_of(data)
            scan = parse_scan(path, data)
            n_returns, n_dropped = len(scan.points), scan.n_absurd
        except DataError as error:
            reasons.append(str(error))
    return FrameRow(
        frame=frame,
        time_s=time_s,
        split=split,
        lidar_to_world=None if pose is None else pose @ calibration.lidar_to_pose,
        scan_valid=n_returns > 0 and pose is not None,
        reason="; ".join(reasons),
        checksum=checksum,
        n_returns=n_returns,
        n_dropped=n_dropped,
    )


def _camera_row(
    layout: DriveLayout, camera: str, frame: int, pose: np.ndarray | None, calibration: Calibration
) -> CameraRow:
    reasons = [] if pose is not None else [_NO_POSE]
    checksum = ""
    path = layout.image_path(camera, frame)
    mounted = calibration.cameras[camera]
    if not lexists(path):
        reasons.append(f"no image file {path.name}")
    else:
        try:
            width, height = mounted.intrinsics.width, mounted.intrinsics.height
            data = read_image_bytes(path, width, height)
            checksum = checksum_of(data)
            decode_image(path, data, width, height)
        except DataError as error:
            reasons.append(str(error))
    return CameraRow(
        frame=frame,
        camera=camera,
        camera_to_world=None if pose is None else pose @ mounted.to_pose,
        image_valid=not reasons,
        reason="; ".join(reasons),
        checksum=checksum,
    )


def _require_something(layout: DriveLayout, frames: list[FrameRow], images: list[CameraRow]) -> None:
    if any(row.scan_valid for row in frames) or any(row.image_valid for row in images):
        return
    section = f"frames {frames[0].frame}..{frames[-1].frame}"
    if not any(row.pose_valid for row in frames):
        raise DataError(
            f"{layout.poses_path}: no line for any of {section}; correct first_frame and last_frame in the "
            "catalogue, or unpack the poses of this sequence"
        )
    rows: list[FrameRow | CameraRow] = [*frames, *images]
    examples = " | ".join(dict.fromkeys(row.reason for row in rows if row.reason))[:600]
    raise DataError(
        f"{layout.root}, sequence {layout.sequence}: {section} hold no usable scan or image ({examples}); "
        "unpack the drive again or correct the catalogue entry"
    )


def _scene_origin_m(frames: list[FrameRow]) -> np.ndarray:
    placed = [row.lidar_to_world for row in frames if row.lidar_to_world is not None]
    return np.round(placed[len(placed) // 2][:3, 3])


def _read_boxes(
    layout: DriveLayout, entry: SceneEntry, origin_m: np.ndarray
) -> tuple[list[Box], list[str], list[str]]:
    """Boxes of the section, reasons for those left out, and notes."""
    require_folder(layout.boxes_dir)
    paths = layout.boxes_paths
    if not paths:
        return [], [], []
    # `train_full`, the last by name, has whole objects; `train` cuts them at its windows.
    found, left_out = read_boxes(paths[-1], entry.first_frame, entry.last_frame)
    boxes = []
    for box in found:
        if np.linalg.norm(box.box_to_world[:3, 3] - origin_m) <= _FARTHEST_BOX_M:
            boxes.append(box)
        else:
            place = f"object {box.object_id} in frame {box.frame}"
            left_out.append(f"{place}: more than {_FARTHEST_BOX_M:g} m away")
    notes = [f"boxes read from {paths[-1].relative_to(layout.root)}"] if len(paths) > 1 else []
    return boxes, left_out, notes


def _disagreement(
    layout: DriveLayout, poses: dict[int, np.ndarray], entry: SceneEntry, calibration: Calibration
) -> PoseDisagreement | None:
    camera0 = calibration.cameras.get("image_00")
    camera0_to_pose = read_rectified_camera0_to_pose(layout) if camera0 is None else camera0.to_pose
    if camera0_to_pose is None or not lexists(layout.cam0_to_world_path):
        return None
    section = range(entry.first_frame, entry.last_frame + 1)
    ours = {frame: poses[frame] @ camera0_to_pose for frame in section if frame in poses}
    return compare_poses(ours, read_cam0_to_world(layout.cam0_to_world_path))
