"""Reading and validation of a section of a drive: its frames and images, their poses, and their faults."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nvsf_core.drives.drive import AbstractDrive, Boxes, DriveFacts, drive_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import STATIC_FRAME, Box
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.drives.kitti360.frames import UNLIKE, FrameTimes, PoseDisagreement
from nvsf_core.drives.kitti360.scans import notes_on_brightest
from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import exp_so3, pose_from_parts

_FARTHEST_BOX_M = 20_000.0
"""Largest distance of a box from the section's middle. All static boxes of a sequence are read: some km."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRow:
    """One frame of the section."""

    frame: int
    time_s: float
    """Seconds since the section's first frame."""
    boxes_time_s: float
    """Moment that its labelled boxes are of, on the same clock."""
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
    brightest: float
    """Intensity of the scan's brightest return, 0..1; 0 without a usable scan."""

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
    time_s: float
    """Seconds since the section's first frame: the image's own time, or its frame's if it has none."""
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
    scene_to_world: np.ndarray
    """(4, 4) float64: the LiDAR's position and heading in the middle frame, z up as in the world."""
    boxes_left_out: tuple[str, ...]
    """Boxes that were left out, and why."""
    has_scans: bool
    """Whether there is a folder of scans; else the drive is camera-only."""
    sensor: str
    """Name of the LiDAR's table; empty = its lasers are to be found from the scans."""
    disagreement: PoseDisagreement | None
    """Of `poses.txt` and `cam0_to_world.txt`; None if the drive does not have both."""
    notes: tuple[str, ...]
    """What was assumed or left out, and why."""
    unread: tuple[str, ...]
    """What seems to be the drive's and is not read, as misnamed files."""


def read_drive(entry: SceneEntry, progress: Callable[[str], None]) -> Drive:
    """Read and validate the section of a catalogue entry.

    A frame that cannot be used is kept, with the reason; it never gets its neighbour's pose.

    Raises:
        CalibrationError: A calibration file is absent, or a key is missing or damaged.
        DataError: A line of poses or times cannot be read, no scan or image of the section can be used, or
            see `AbstractDrive.unread` and `require_sweep_within_step`.
    """
    source = drive_of(entry)
    # First: what else seems to lack may have another name.
    unread = source.unread()
    facts = source.facts()
    require_sweep_within_step(source, facts)
    calibration, times = facts.calibration, facts.times
    frames, images = [], []
    for index, frame in enumerate(source.frames):
        progress(f"reading frame {frame}, {index} of {len(times.time_s)} done")
        frames.append(_frame_row(source, facts, frame, float(times.time_s[index])))
        images += [_camera_row(source, facts, name, frames[-1]) for name in calibration.cameras]
    _require_something(source, facts, frames, images)
    labelled = source.boxes()
    scene_to_world = _scene_to_world(frames)
    boxes, left_out = _usable_boxes(labelled, scene_to_world[:3, 3])
    notes = [*calibration.notes, *boxes.notes, *facts.notes]
    notes += notes_on_brightest(max(row.brightest for row in frames))
    if calibration.lidar_is_assumed:
        notes.append("no LiDAR mounting (camera-only drive): lidar_to_world is the pose frame, turned z up")
    return Drive(
        frames=tuple(frames),
        images=tuple(images),
        boxes=boxes.boxes,
        boxes_left_out=(*boxes.left_out, *left_out),
        has_scans=facts.has_scans,
        sensor=facts.sensor,
        calibration=calibration,
        times=times,
        scene_to_world=scene_to_world,
        disagreement=facts.disagreement,
        notes=tuple(notes),
        unread=tuple(unread),
    )


def require_sweep_within_step(source: AbstractDrive, facts: DriveFacts) -> None:
    """Refuse a given `sweep_period_s` that is longer than from one scan to the next.

    A LiDAR ends a sweep before it begins another: returns would be moved by a way that nobody drove. Allowed
    is what the recording's own times show, as of data sets that were rendered at a higher rate.

    Raises:
        DataError: It is longer; the message says by how much.
    """
    scene, times = source.scene, facts.times
    given_s = scene.sweep_period_s
    if given_s is None or not facts.has_scans or times.is_assumed or not scene.is_to_compensate:
        return
    if not _is_longer(given_s, times.time_s):
        return
    own_s = drive_of(replace(scene, sweep_period_s=None)).times().sweep_period_s
    # Frames may also be images' alone, at a higher rate than the scans'.
    there = [_has_scan(source, frame) for frame in source.frames]
    if given_s > (1.0 + UNLIKE) * own_s and _is_longer(given_s, times.time_s[there]):
        raise DataError(
            f"scene {scene.name}: sweep_period_s: expected at most the time from one scan to the next, "
            f"{np.median(np.diff(times.time_s[there])):.4g} s in the median, found {given_s:g}; correct it, "
            "or leave it out"
        )


def _is_longer(given_s: float, time_s: np.ndarray) -> bool:
    """Whether a sweep is longer than the median step of these times (n,); False where there is no step."""
    return len(time_s) > 1 and given_s > (1.0 + UNLIKE) * float(np.median(np.diff(time_s)))


def _has_scan(source: AbstractDrive, frame: int) -> bool:
    try:
        return source.find_scan(frame) is not None
    except DataError:  # It is there; where the frame itself is read, it is named.
        return True


def _frame_row(source: AbstractDrive, facts: DriveFacts, frame: int, time_s: float) -> FrameRow:
    pose = facts.poses.get(frame)
    reasons = [] if pose is not None else [source.why_no_pose(frame, facts.poses_place.name)]
    checksum, n_returns, n_dropped, brightest = "", 0, 0, 0.0
    if not facts.has_scans:
        reasons.append("camera-only drive")
    else:
        try:
            found = source.find_scan(frame)
            if found is None:
                reasons.append(f"no scan file {source.scan_name(frame)}")
            else:
                checksum = found.checksum
                scan = source.parse_scan(found)
                n_returns, n_dropped = len(scan.points), scan.n_absurd
                brightest = float(scan.points[:, 3].max())
        except DataError as error:
            reasons.append(str(error))
    return FrameRow(
        frame=frame,
        time_s=time_s,
        boxes_time_s=time_s + facts.boxes_after_s,
        split="test" if frame in source.scene.test_frames else "train",
        lidar_to_world=None if pose is None else pose @ facts.calibration.lidar_to_pose,
        scan_valid=n_returns > 0 and pose is not None,
        reason="; ".join(reasons),
        checksum=checksum,
        n_returns=n_returns,
        n_dropped=n_dropped,
        brightest=brightest,
    )


def _camera_row(source: AbstractDrive, facts: DriveFacts, camera: str, row: FrameRow) -> CameraRow:
    frame, pose = row.frame, facts.poses.get(row.frame)
    reasons = [] if pose is not None else [source.why_no_pose(frame, facts.poses_place.name)]
    checksum, to_world = "", None
    mounted = facts.calibration.cameras[camera]
    try:
        if pose is not None:
            to_world = source.pose_at_image(camera, frame, pose) @ mounted.to_pose
        width, height = mounted.intrinsics.width, mounted.intrinsics.height
        found = source.find_image(camera, frame, width, height)
        if found is None:
            reasons.append(f"no image file {source.image_name(camera, frame)}")
        else:
            checksum = found.checksum
            source.parse_image(camera, found, width, height)
    except DataError as error:
        reasons.append(str(error))
    return CameraRow(
        frame=frame,
        camera=camera,
        camera_to_world=to_world,
        time_s=row.time_s + (source.image_delay_s(camera, frame) or 0.0),
        image_valid=not reasons,
        reason="; ".join(reasons),
        checksum=checksum,
    )


def _require_something(
    source: AbstractDrive, facts: DriveFacts, frames: list[FrameRow], images: list[CameraRow]
) -> None:
    if any(row.scan_valid for row in frames) or any(row.image_valid for row in images):
        return
    section = f"frames {frames[0].frame}..{frames[-1].frame}"
    if not any(row.pose_valid for row in frames):
        raise DataError(
            f"{facts.poses_place}: no line for any of {section}; correct first_frame and last_frame in the "
            "catalogue, or unpack the poses of this sequence"
        )
    rows: list[FrameRow | CameraRow] = [*frames, *images]
    examples = " | ".join(dict.fromkeys(row.reason for row in rows if row.reason))[:600]
    raise DataError(
        f"{source.scene.root}, sequence {source.scene.sequence}: {section} hold no usable scan or image "
        f"({examples}); unpack the drive again or correct the catalogue entry"
    )


def _scene_to_world(frames: list[FrameRow]) -> np.ndarray:
    placed = [row.lidar_to_world for row in frames if row.lidar_to_world is not None]
    middle = placed[len(placed) // 2]
    heading_rad = np.arctan2(middle[1, 0], middle[0, 0])
    return pose_from_parts(exp_so3(np.array([0.0, 0.0, heading_rad])), middle[:3, 3])


def _usable_boxes(found: Boxes, origin_m: np.ndarray) -> tuple[Boxes, list[str]]:
    """The boxes near the section, one of an object in a frame, and a reason for each of the others.

    A static box is one of its object in every frame; a static object may have several.
    """
    usable, left_out = [], []
    count = Counter((box.frame, box.object_id) for box in found.boxes)
    in_frames = {object_id for frame, object_id in count if frame != STATIC_FRAME}
    for box in found.boxes:
        number, is_static = box.object_id, box.frame == STATIC_FRAME
        place = f"object {number} in {'every frame (-1)' if is_static else f'frame {box.frame}'}"
        times = 1 if is_static else count[box.frame, number] + count[STATIC_FRAME, number]
        if np.linalg.norm(box.box_to_world[:3, 3] - origin_m) > _FARTHEST_BOX_M:
            left_out.append(f"{place}: more than {_FARTHEST_BOX_M:g} m away")
        elif times > 1:
            # It is at one place at a time, and nothing says at which.
            left_out.append(f"{place}: expected one box, found {times}")
        elif is_static and number in in_frames:
            left_out.append(f"{place}: expected no boxes of single frames beside it, found some")
        elif is_static and box.dynamic:
            left_out.append(f"{place}: expected a static object, found a dynamic one")
        else:
            usable.append(box)
    return replace(found, boxes=tuple(usable)), left_out
