"""Writing of a plain drive (docs/drives.md), a frame at a time."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.frames import FrameTimes
from nvsf_core.drives.kitti360.scans import Scan, write_column, write_scan
from nvsf_core.drives.kitti360.writer import write_image, write_text
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.names import printable


def write_description(
    layout: PlainLayout,
    lidar: str,
    notes: Sequence[str] = (),
    times: FrameTimes | None = None,
    boxes_after_s: float = 0.0,
) -> None:
    """Write `drive.json`.

    Args:
        layout: Of the drive.
        lidar: The LiDAR's name; empty = to be found.
        notes: What was assumed.
        times: What the drive's clock is, and whether it is assumed.
        boxes_after_s: Seconds from a frame's time to the moment that its boxes are of.
    """
    clock: dict[str, Any] = {}
    if times is not None and times.is_assumed:
        clock["times_assumed"] = printable(times.source)
    if times is not None and times.origin_s is not None:
        clock["clock_origin_s"] = round(times.origin_s, 6)
    if boxes_after_s:
        clock["boxes_after_s"] = round(boxes_after_s, 9)
    _write_json(layout.drive_path, {"lidar": lidar or "found", **clock, "notes": list(notes)})


def write_poses(
    layout: PlainLayout,
    frames: Sequence[int] | None,
    time_s: Sequence[float],
    poses: Sequence[np.ndarray],
) -> None:
    """Write `poses.csv`: of each moment its frame and the LiDAR's pose (4, 4) in the world, metres.

    Without frames, `frames.csv` says when they were.
    """
    names = [f"m{row}{column}" for row in range(3) for column in range(4)]
    lines = [",".join([*(() if frames is None else ("frame",)), "time_s", *names])]
    for number, (moment_s, pose) in enumerate(zip(time_s, poses, strict=True)):
        own = [] if frames is None else [str(frames[number])]
        lines.append(",".join([*own, f"{moment_s:.9f}", *map(_digits, pose[:3].reshape(-1))]))
    _write_lines(layout.poses_path, lines)


def write_frame_times(layout: PlainLayout, time_s: Mapping[int, float]) -> None:
    """Write `frames.csv`: times of all frames, also of those without a pose."""
    _write_lines(layout.frames_path, ["frame,time_s", *(f"{k},{one:.9f}" for k, one in time_s.items())])


def write_image_times(layout: PlainLayout, camera: str, time_s: Mapping[int, float]) -> None:
    """Write the times of a camera's images, seconds on the frames' clock."""
    lines = ["frame,time_s", *(f"{frame},{one:.9f}" for frame, one in sorted(time_s.items()))]
    _write_lines(layout.image_times_path(camera), lines)


def write_cameras(
    layout: PlainLayout, cameras: Mapping[str, tuple[Pinhole | MeiFisheye, np.ndarray]]
) -> None:
    """Write `cameras.json`: of each camera its model and its pose (4, 4) in the LiDAR's frame."""
    found: dict[str, Any] = {}
    for name, (model, to_lidar) in cameras.items():
        kind = "pinhole" if isinstance(model, Pinhole) else "mei"
        found[name] = {"model": kind, **asdict(model), "camera_to_lidar": to_lidar.reshape(-1).tolist()}
    _write_json(layout.cameras_path, found)


def write_plain_scan(layout: PlainLayout, frame: int, scan: Scan) -> None:
    """Write a scan as `.bin`, and its rings and times beside it."""
    write_scan(layout.scan_path(frame), scan.points[:, :3], scan.points[:, 3])
    beside = (("ring", scan.ring, "<u2"), ("time", scan.offset_s, "<f4"))
    for name, values, kind in beside:
        if values is not None:
            write_column(layout.beside_path(name, frame), values.astype(kind))


def write_plain_image(layout: PlainLayout, camera: str, frame: int, rgb: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8, red first, as PNG."""
    write_image(layout.image_path(camera, frame), rgb)


def write_plain_boxes(layout: PlainLayout, boxes: Iterable[Box]) -> None:
    """Write `boxes.csv`; sheared boxes keep their axes' lengths and the nearest rotation."""
    head = "frame,object_id,label,dynamic,x,y,z,qx,qy,qz,qw,length,width,height"
    lines = [head]
    for box in boxes:
        sides_m = np.linalg.norm(box.box_to_world[:3, :3], axis=0)
        left, _, right = np.linalg.svd(box.box_to_world[:3, :3] / sides_m)
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        numbers = [*box.box_to_world[:3, 3], *Rotation.from_matrix(turn).as_quat(), *sides_m]
        label = "".join(one for one in box.label if one.isprintable() and one not in '",')
        words = [str(box.frame), str(box.object_id), label, str(int(box.dynamic))]
        lines.append(",".join([*words, *map(_digits, numbers)]))
    if len(lines) > 1:
        _write_lines(layout.boxes_path, lines)


def _digits(value: float) -> str:
    return format(float(value), ".12g")


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    write_text(path, "\n".join(lines) + "\n")


def _write_json(path: Path, facts: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(facts, indent=1) + "\n")
