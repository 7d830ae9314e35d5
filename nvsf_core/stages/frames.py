"""Stage `frames`: tables of the drive's frames, images and boxes, validated."""

import itertools
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.drives.drive import has_data, why_no_data
from nvsf_core.drives.validation import Drive, read_drive
from nvsf_core.errors import NoDataError
from nvsf_core.geometry.se3 import invert_pose, poses_in
from nvsf_core.reporting.previews import path_preview
from nvsf_core.sensors.tables import HDL_64E
from nvsf_core.stages.runner.heartbeat import sparse
from nvsf_core.stages.runner.stage import Check, StageOutput, Task
from nvsf_core.stores.tables import write_table

FRAME_COLUMNS = (
    "frame",
    "time_s",
    "split",
    "lidar_to_world",
    "pose_valid",
    "scan_valid",
    "reason",
    "checksum",
)
CAMERA_COLUMNS = ("frame", "camera", "time_s", "camera_to_world", "image_valid", "reason", "checksum")
BOX_COLUMNS = ("frame", "object_id", "label", "dynamic", "box_to_world")

_SECONDS_PER_LINE = 2.0
_POSE_TOLERANCE_M = 0.02
"""Rounding of the pose files: world coordinates of some 1000 m, rotations of 6 digits on a 1.6 m lever."""
_POSE_TOLERANCE_DEG = 0.01
_MAX_SPEED_M_S = 70.0
_FEWEST_OF_MEDIAN = 0.5
"""Least returns of a scan, as a share of the median scan's; 0.87 at least over real streets."""
_JUMP_M_S = 700.0
"""Speed between poses above which one of them is certainly wrong; twice the speed of sound."""


def run(task: Task) -> StageOutput:
    """Read the drive and write its table of frames; the stage `frames`."""
    if not has_data(task.scene):
        raise NoDataError(f"scene {task.scene.name}: {why_no_data(task.scene)}")
    say = sparse(task.progress, _SECONDS_PER_LINE)
    drive = read_drive(task.scene, lambda line: say(f"[{task.scene.name}] frames: {line}"))
    _write(task.folder, drive)
    (task.folder / "path.png").write_bytes(_path_picture(drive))
    return StageOutput(metadata=_metadata(drive), checks=_checks(drive), previews={"path": "path.png"})


def _write(folder: Path, drive: Drive) -> None:
    is_apart = drive.boxes and any(row.boxes_time_s != row.time_s for row in drive.frames)
    columns = (*FRAME_COLUMNS, "boxes_time_s") if is_apart else FRAME_COLUMNS
    _write_table(folder / "frames.parquet", drive.frames, columns)
    _write_table(folder / "cameras.parquet", drive.images, CAMERA_COLUMNS)
    _write_table(folder / "boxes.parquet", drive.boxes, BOX_COLUMNS)
    facts: dict[str, Any] = {
        "scene_to_world": drive.scene_to_world.reshape(-1).tolist(),
        "sweep_period_s": drive.times.sweep_period_s,
        "period_assumed": drive.times.is_assumed,
        "time_source": drive.times.source,
        "cameras": {name: camera.facts() for name, camera in drive.calibration.cameras.items()},
        "camera_in_lidar": {
            name: (invert_pose(drive.calibration.lidar_to_pose) @ camera.to_pose).reshape(-1).tolist()
            for name, camera in drive.calibration.cameras.items()
        },
        "notes": list(drive.notes),
    }
    if drive.times.origin_s is not None:
        facts["clock_origin_s"] = round(drive.times.origin_s, 6)
    if drive.sensor != HDL_64E.name:  # KITTI's own needs no word
        facts["sensor"] = drive.sensor
    (folder / "drive.json").write_text(json.dumps(facts, indent=1))


def _write_table(path: Path, rows: Iterable[object], names: Sequence[str]) -> None:
    """Write attributes of each row as columns; poses row by row as lists, empty for an unknown pose."""

    def stored(value: Any, name: str) -> Any:
        if not name.endswith("_to_world"):
            return value
        return [] if value is None else value.reshape(-1).tolist()

    write_table(path, {name: [stored(getattr(row, name), name) for row in rows] for name in names})


def _metadata(drive: Drive) -> dict[str, Scalar]:
    placed = [row.lidar_to_world[:3, 3] for row in drive.frames if row.lidar_to_world is not None]
    path_m = float(np.linalg.norm(np.diff(np.stack(placed), axis=0), axis=1).sum())
    metadata: dict[str, Scalar] = {
        "frames": len(drive.frames),
        "test_frames": sum(row.split == "test" for row in drive.frames),
        "frames_without_pose": sum(not row.pose_valid for row in drive.frames),
        "usable_scans": sum(row.scan_valid for row in drive.frames),
        "usable_images": sum(row.image_valid for row in drive.images),
        "unusable_images": sum(not row.image_valid for row in drive.images),
        "cameras": ", ".join(drive.calibration.cameras) or "none",
        "returns": sum(row.n_returns for row in drive.frames),
        "absurd_returns_dropped": sum(row.n_dropped for row in drive.frames),
        "moving_objects": len({box.object_id for box in drive.boxes if box.dynamic}),
        "boxes": len(drive.boxes),
        "path_length_m": round(path_m, 3),
        "duration_s": round(float(drive.times.time_s[-1]), 3),
        "sweep_period_s": round(drive.times.sweep_period_s, 6),
        "period_assumed": drive.times.is_assumed,
        "time_source": drive.times.source,
    }
    if drive.notes:
        metadata["notes"] = "; ".join(drive.notes)
    return metadata


def _path_picture(drive: Drive) -> bytes:
    images: dict[int, list[bool]] = {}
    for row in drive.images:
        images.setdefault(row.frame, []).append(row.image_valid)
    path_m, frames, splits, uses = [], [], [], []
    for frame in drive.frames:
        if frame.lidar_to_world is None:
            continue
        parts = images.get(frame.frame, []) + ([frame.scan_valid] if drive.has_scans else [])
        path_m.append(poses_in(drive.scene_to_world, frame.lidar_to_world)[:2, 3])
        frames.append(frame.frame)
        splits.append(frame.split)
        uses.append("whole" if all(parts) else "part" if any(parts) else "none")
    return path_preview(np.array(path_m).reshape(-1, 2), frames, splits, uses)


def _checks(drive: Drive) -> list[Check]:
    usable = {row.frame for row in drive.frames if row.scan_valid}
    usable |= {row.frame for row in drive.images if row.image_valid}
    training = [row.frame for row in drive.frames if row.split == "train" and row.frame in usable]
    held_out = [row for row in drive.frames if row.split == "test"]
    placed = {row.frame for row in drive.frames if row.pose_valid}
    unplaced = [row.frame for row in drive.frames if not row.pose_valid]
    bad_scans = [
        f"{row.frame}: {row.reason}" for row in drive.frames if row.pose_valid and not row.scan_valid
    ]
    bad_images = [
        f"{row.camera} {row.frame}: {row.reason}"
        for row in drive.images
        if row.frame in placed and not row.image_valid
    ]
    lost = [row.frame for row in held_out if row.frame not in usable]
    checks = [
        Check(
            name="at_least_one_valid_training_frame",
            passed=bool(training),
            detail=f"{len(training)} of {len(drive.frames) - len(held_out)} training frames can be used",
            blocking=True,
        ),
        _listing("all_frames_have_a_pose", unplaced, "frames without a pose"),
        _listing("all_images_are_usable", bad_images, "images left out"),
        _listing("all_held_out_frames_are_usable", lost, "held-out frames that cannot be used"),
        _speed_check(drive),
        _jump_check(drive),
        Check(name="timestamps_are_usable", passed=not drive.times.is_refused, detail=drive.times.source),
    ]
    if drive.has_scans:
        checks.append(_listing("all_scans_are_usable", bad_scans, "scans left out"))
        checks.append(_sizes_check(drive))
        checks.append(_repeats("every_scan_is_another", [(row.frame, row.checksum) for row in drive.frames]))
    for camera in drive.calibration.cameras:
        own = [(row.frame, row.checksum) for row in drive.images if row.camera == camera]
        checks.append(_repeats(f"every_image_of_{camera}_is_another", own))
    uncalibrated = list(drive.calibration.notes)
    checks.append(_listing("all_cameras_are_calibrated", uncalibrated, "cameras left out"))
    checks.append(_listing("all_boxes_are_usable", list(drive.boxes_left_out), "boxes left out"))
    if drive.unread:
        checks.append(_listing("all_names_are_known", list(drive.unread), "kinds of files passed over"))
    if drive.disagreement is not None:
        gap = drive.disagreement
        checks.append(
            Check(
                name="cam0_to_world_agrees_with_poses",
                passed=gap.translation_m <= _POSE_TOLERANCE_M and gap.rotation_deg <= _POSE_TOLERANCE_DEG,
                detail="no frame has a pose in both"
                if gap.frames == 0
                else f"at most {1000 * gap.translation_m:.2f} mm and {gap.rotation_deg:.5f} deg apart "
                f"over {gap.frames} frames",
            )
        )
    return checks


def _listing(name: str, faults: list[Any], what: str) -> Check:
    detail = f"{len(faults)} {what}" + (f": {_first(faults)}" if faults else "")
    return Check(name=name, passed=not faults, detail=detail)


def _first(faults: list[Any]) -> str:
    return "; ".join(str(fault) for fault in faults[:5]) + ("; ..." if len(faults) > 5 else "")


def _sizes_check(drive: Drive) -> Check:
    """Check for scans with far fewer returns than the others: cut files, or a covered sensor."""
    counts = {row.frame: row.n_returns for row in drive.frames if row.scan_valid}
    median = float(np.median(list(counts.values()))) if counts else 0.0
    few = [f"{frame}: {count}" for frame, count in counts.items() if count < _FEWEST_OF_MEDIAN * median]
    return _listing(
        "scans_are_of_one_size", few, f"scans with less than a part of the median's {median:.0f} returns"
    )


def _repeats(name: str, files: list[tuple[int, str]]) -> Check:
    """Check for identical files: sensor noise differs between frames even if nothing moves."""
    frames: dict[str, list[int]] = {}
    for frame, checksum in files:
        if checksum:
            frames.setdefault(checksum, []).append(frame)
    same = [f"frames {', '.join(map(str, group))}" for group in frames.values() if len(group) > 1]
    return _listing(name, same, "groups of frames with the same file")


def _speed_check(drive: Drive) -> Check:
    """Check the car's speed: a jump means a pose of another frame, or times in another unit."""
    fastest, _, frame = max(_speeds_m_s(drive), default=(0.0, 0, 0))
    return Check(
        name="car_moves_plausibly",
        passed=fastest <= _MAX_SPEED_M_S,
        detail=f"fastest step {fastest:.1f} m/s, to frame {frame}; expected at most {_MAX_SPEED_M_S:.0f}",
    )


def _jump_check(drive: Drive) -> Check:
    """Check, blocking, for impossible jumps: such poses make the scene too large to be trained."""
    jumps = [
        f"frame {there} ({speed_m_s:.3g} m/s from frame {here})"
        for speed_m_s, here, there in _speeds_m_s(drive)
        if speed_m_s > _JUMP_M_S
    ]
    detail = f"{len(jumps)} jumps of more than {_JUMP_M_S:.0f} m/s"
    if jumps:
        detail += f": {_first(jumps)}; correct these poses, or delete them from the drive"
    return Check(name="no_pose_jumps", passed=not jumps, detail=detail, blocking=True)


def _speeds_m_s(drive: Drive) -> list[tuple[float, int, int]]:
    """Speed in m/s from each posed frame to the next, with both frame numbers."""
    placed = [
        (row.frame, row.time_s, row.lidar_to_world[:3, 3])
        for row in drive.frames
        if row.lidar_to_world is not None
    ]
    return [
        (float(np.linalg.norm(there_m - here_m)) / (then_s - now_s), here, there)
        for (here, now_s, here_m), (there, then_s, there_m) in itertools.pairwise(placed)
    ]
