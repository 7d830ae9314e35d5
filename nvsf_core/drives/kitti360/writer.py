"""Writing of a drive's files in KITTI-360's formats."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from html import escape
from pathlib import Path

import cv2
import numpy as np

from nvsf_core.drives.kitti360.boxes import Box, number_in_boxes
from nvsf_core.drives.kitti360.layout import CAMERAS, FISHEYE_CAMERAS, DriveLayout
from nvsf_core.errors import DataError, ShapeError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole

_CUBE = (
    "0.5 0.5 0.5 0.5 0.5 -0.5 0.5 -0.5 0.5 0.5 -0.5 -0.5 "
    "-0.5 0.5 -0.5 -0.5 0.5 0.5 -0.5 -0.5 -0.5 -0.5 -0.5 0.5"
)
_NOT_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_CUBE_FACES = "0 1 3 0 3 2 5 4 6 5 6 7 0 5 4 0 4 1 2 3 6 2 6 7 0 2 7 0 7 5 1 4 6 1 6 3"
MOST_LINES_BEFORE = 100_000
"""Of timestamps, for frames before a section: several times those of KITTI-360's longest drive. Of a section
that begins later only its own lines are written, as of a drive that was cut out of a longer one."""
UNDATED_S = 3600.0
"""Second 0 of a written drive of no known date, from 1970-01-01: formats need one, and none before 1970."""


@dataclass(frozen=True, slots=True)
class RectifiedCamera:
    """A perspective camera, with the values of `perspective.txt`."""

    pinhole: Pinhole
    """Of the rectified image."""
    baseline_m: float = 0.0
    """Distance to the right of camera 0, along the rectified x axis."""
    rectification: np.ndarray = field(default_factory=lambda: np.eye(3))
    """R_rect (3, 3): unrectified to rectified camera."""


def flat_fisheye(pinhole: Pinhole) -> MeiFisheye:
    """A pinhole camera in the place of a fisheye: without xi and distortion the model is one."""
    return MeiFisheye(
        xi=0.0, k1=0.0, k2=0.0, p1=0.0, p2=0.0, gamma1=pinhole.fx, gamma2=pinhole.fy, u0=pinhole.cx,
        v0=pinhole.cy, width=pinhole.width, height=pinhole.height,
    )  # fmt: skip


def write_image(path: Path, rgb: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8, red first, as PNG.

    Raises:
        ShapeError: The array has another shape or type.
        DataError: The file cannot be written.
    """
    _write_png(path, _blue_first(rgb, f" for {path}"))


def png_bytes(rgb: np.ndarray) -> bytes:
    """An image (H, W, 3) uint8, red first, as PNG.

    Raises:
        ShapeError: The array has another shape or type.
    """
    return bytes(cv2.imencode(".png", _blue_first(rgb), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def _blue_first(rgb: np.ndarray, where: str = "") -> np.ndarray:
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ShapeError(
            f"expected an image (H, W, 3) uint8, found {rgb.shape} {rgb.dtype}{where}; convert it"
        )
    return rgb[..., ::-1]


def write_grey(path: Path, values: np.ndarray, kind: type[np.unsignedinteger]) -> None:
    """Write a value (H, W) of each pixel of an image, uint8 or uint16 as `kind` says, as a grey PNG.

    Raises:
        ShapeError: The array has another shape or type.
        DataError: The file cannot be written.
    """
    if values.dtype != kind or values.ndim != 2:
        raise ShapeError(
            f"expected values (H, W) {kind.__name__}, found {values.shape} {values.dtype} for {path}"
        )
    _write_png(path, values)


def read_numbers(path: Path) -> np.ndarray:
    """Read what `write_grey` wrote: (H, W) uint16.

    Raises:
        DataError: The file is none of that kind.
    """
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None or found.dtype != np.uint16 or found.ndim != 2:
        raise DataError(f"{path}: expected a grey PNG of 16 bits, found something else; make it anew")
    return np.asarray(found)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Level 1: images are written once and read often, and higher levels hardly compress smooth ones more.
    if not cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise DataError(f"expected to write {path}, found that the disk refuses it; check space and rights")


def write_calibration(
    layout: DriveLayout,
    models: Mapping[str, RectifiedCamera | Pinhole | MeiFisheye],
    to_pose: Mapping[str, np.ndarray],
    cam0_to_lidar: np.ndarray,
) -> None:
    """Write the intrinsics and mountings (4, 4) of a drive's cameras, by their names in the layout.

    A pinhole in the place of a fisheye is written as a fisheye without distortion.
    """
    perspective = {}
    for name, model in models.items():
        if name in FISHEYE_CAMERAS:
            assert not isinstance(model, RectifiedCamera), "rectified cameras have the places of such"
            fisheye = flat_fisheye(model) if isinstance(model, Pinhole) else model
            write_fisheye(layout.fisheye_path(name), name, fisheye)
        else:
            assert not isinstance(model, MeiFisheye), "fisheyes have the places of fisheyes"
            perspective[name] = RectifiedCamera(model) if isinstance(model, Pinhole) else model
    if perspective:
        write_perspective(layout.perspective_path, perspective)
    write_cam_to_pose(layout.cam_to_pose_path, to_pose)
    write_text(layout.cam_to_velo_path, _numbers(cam0_to_lidar[:3]) + "\n")


def write_times(
    layout: DriveLayout,
    cameras: Iterable[str],
    time_s: np.ndarray,
    sweep_s: float,
    origin_s: float | None,
) -> None:
    """Write the times of the frames from frame 0, of the scans' begins and ends, and of the cameras.

    Args:
        layout: Where.
        cameras: Those that have images.
        time_s: (n,) seconds of the frames.
        sweep_s: Duration of a sweep; 0 = scans are of one instant.
        origin_s: Seconds from 1970-01-01 to second 0; None = not known. The files have no time zone.
    """
    start = datetime(1970, 1, 1) + timedelta(seconds=UNDATED_S if origin_s is None else origin_s)
    for kind, shift_s in (("", 0.0), ("start", -0.5 * sweep_s), ("end", 0.5 * sweep_s)):
        write_timestamps(layout.timestamps_path(kind), start, (time_s + shift_s).tolist())
    for camera in cameras:
        write_timestamps(layout.camera_timestamps_path(camera), start, time_s.tolist())


def write_frame_poses(path: Path, frames: Sequence[int], poses: np.ndarray, rows: int) -> None:
    """Write `poses.txt` (rows = 3) or `cam0_to_world.txt` (rows = 4): a frame number and a matrix a line.

    `poses` are (n, 4, 4) to the world, metres, one a frame.
    """
    lines = [f"{frame} {_numbers(pose[:rows])}" for frame, pose in zip(frames, poses, strict=True)]
    write_text(path, "\n".join(lines) + "\n")


def write_cam_to_pose(path: Path, cam_to_pose: Mapping[str, np.ndarray]) -> None:
    """Write `calib_cam_to_pose.txt`: in each line a name and the unrectified camera's mounting, of (4, 4).

    The data set's own scripts want four lines: cameras that are not there are given the first one's.
    """
    any_pose = next(iter(cam_to_pose.values()))
    known = {**dict.fromkeys(CAMERAS, any_pose), **cam_to_pose}
    write_text(path, "".join(f"{name}: {_numbers(pose[:3])}\n" for name, pose in known.items()))


def write_perspective(path: Path, cameras: Mapping[str, RectifiedCamera]) -> None:
    """Write `perspective.txt`: rectified and (nominal) raw intrinsics of `image_00` and `image_01`.

    A drive has no raw images, so K, D and S are those of the rectified ones. KITTI-360's `calib_time` is left
    out: nobody knows when the cameras were calibrated.
    """
    lines = ["corner_dist: 0.100000"]
    for name, camera in cameras.items():
        tag = name[-2:]
        pinhole = camera.pinhole
        k = pinhole.matrix
        p = np.column_stack([k, [-pinhole.fx * camera.baseline_m, 0.0, 0.0]])
        size = f"{pinhole.width:.6f} {pinhole.height:.6f}"
        lines += [
            f"S_{tag}: {size}",
            f"K_{tag}: {_numbers(k)}",
            f"D_{tag}: {_numbers(np.zeros(5))}",
            f"R_{tag}: {_numbers(np.eye(3))}",
            f"T_{tag}: {_numbers(np.array([-camera.baseline_m, 0.0, 0.0]))}",
            f"S_rect_{tag}: {size}",
            f"R_rect_{tag}: {_numbers(camera.rectification)}",
            f"P_rect_{tag}: {_numbers(p)}",
        ]
    write_text(path, "\n".join(lines) + "\n")


def write_fisheye(path: Path, name: str, camera: MeiFisheye) -> None:
    """Write `image_02.yaml`: the MEI model of a fisheye camera, in the format of OpenCV's file storage."""
    groups = {
        "mirror_parameters": ("xi",),
        "distortion_parameters": ("k1", "k2", "p1", "p2"),
        "projection_parameters": ("gamma1", "gamma2", "u0", "v0"),
    }
    lines = [
        "%YAML:1.0",
        "model_type: MEI",
        f"camera_name: {name}",
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
    ]
    for group, keys in groups.items():
        lines.append(f"{group}:")
        lines += [f"   {key}: {getattr(camera, key):.16e}" for key in keys]
    write_text(path, "\n".join(lines) + "\n")


def write_timestamps(path: Path, start: datetime, offsets_s: Iterable[float]) -> None:
    """Write timestamps: one line a frame from frame 0, seconds with nine digits as in KITTI."""
    times = [start + timedelta(seconds=offset) for offset in offsets_s]
    write_text(path, "".join(f"{time.isoformat(' ', 'microseconds')}000\n" for time in times))


def write_boxes(path: Path, boxes: Iterable[Box], first_frame: int, last_frame: int) -> None:
    """Write `data_3d_bboxes/*/<sequence>.xml`: one element a box, in the format of OpenCV's file storage.

    Objects are said to be visible from the first to the last frame. Of their numbers the layout writes those
    within the class, the last three digits; its readers put the class in front. Labels that are none of
    KITTI-360's classes are written as unknown objects, with their name.
    """
    shown = {"start_frame": first_frame, "end_frame": last_frame}
    objects = "".join(_box_xml(index, box, shown) for index, box in enumerate(boxes))
    write_text(path, f'<?xml version="1.0"?>\n<opencv_storage>\n{objects}</opencv_storage>\n')


def _box_xml(index: int, box: Box, shown: Mapping[str, int]) -> str:
    instance = box.object_id % 1000
    fields = {
        "index": index,
        "label": box.label,
        "category": "vehicle" if box.label in ("car", "bicycle") else "human",
        "semanticId": number_in_boxes(box.label),
        "instanceId": instance,
        "timestamp": box.frame,
        "dynamic": int(box.dynamic),
        "dynamicSeq": instance if box.dynamic else -1,
        **shown,
    }
    text = "".join(f"  <{key}>{_in_xml(value)}</{key}>\n" for key, value in fields.items())
    matrices = (
        _matrix_xml("transform", 4, 4, "f", " ".join(f"{v:.12e}" for v in box.box_to_world.ravel()))
        + _matrix_xml("vertices", 8, 3, "f", _CUBE)
        + _matrix_xml("faces", 12, 3, "i", _CUBE_FACES)
    )
    return f"<object{index}>\n{text}{matrices}</object{index}>\n"


def _in_xml(value: object) -> str:
    """A value as the text of an element; what XML has no character for is left out."""
    return escape(_NOT_IN_XML.sub("", str(value)), quote=False)


def _matrix_xml(name: str, rows: int, columns: int, kind: str, data: str) -> str:
    return (
        f'  <{name} type_id="opencv-matrix">\n    <rows>{rows}</rows>\n    <cols>{columns}</cols>\n'
        f"    <dt>{kind}</dt>\n    <data>\n      {data}</data></{name}>\n"
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.10f}" for value in np.ravel(values))


def write_text(path: Path, text: str) -> None:
    """Write a text file; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
