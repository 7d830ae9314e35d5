"""Intrinsics and mounting of the cameras and the LiDAR, read from KITTI-360's calibration files.

Frames: `poses.txt` has the poses of the pose frame (x forward, y right, z down) in the world; the LiDAR has
x forward, y left, z up; a camera x right, y down, z forward. The files give mountings of unrectified
cameras; a perspective image is rectified: `x_rectified = R_rect x_camera`.
"""

from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.layout import CAMERAS, PERSPECTIVE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.text import KeyedText, read_mounting, require_folder, rotation
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole, intrinsics_fault, recorded_size_fault

_SKEW_TOLERANCE = 1e-9
"""Largest skew or rotation in the projection of a rectified camera."""

_LONGEST_BASELINE_M = 10.0
"""Longest distance between two cameras of one car."""

_POSE_FRAME_TO_Z_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""LiDAR to pose frame in a camera-only drive: a LiDAR is assumed at the pose frame's origin."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCalibration:
    """Intrinsics and mounting of one camera, of any format of drives.

    Raises:
        CalibrationError: Its images are too small.
    """

    name: str
    intrinsics: Pinhole | MeiFisheye
    to_pose: np.ndarray
    """(4, 4) float64, camera to pose frame, of the stored image (rectified if perspective)."""

    def __post_init__(self) -> None:
        """Refuse a size that nothing can be rendered from."""
        fault = recorded_size_fault(self.intrinsics.width, self.intrinsics.height)
        if fault is not None:
            raise CalibrationError(f"camera {self.name}: {fault}")

    @property
    def kind(self) -> str:
        """`perspective` or `fisheye`."""
        return "perspective" if isinstance(self.intrinsics, Pinhole) else "fisheye"

    def facts(self) -> dict[str, float | int | str]:
        """Kind, size and intrinsics as plain JSON values, in the stored order."""
        size = {"width": self.intrinsics.width, "height": self.intrinsics.height}
        return {"kind": self.kind, **size, **asdict(self.intrinsics)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Mounting of the LiDAR, and calibration of the cameras."""

    lidar_to_pose: np.ndarray
    """(4, 4) float64, LiDAR to pose frame."""
    lidar_is_assumed: bool
    """True if no file has the LiDAR's mounting: it is then assumed at the pose frame's origin."""
    cameras: dict[str, CameraCalibration]
    notes: tuple[str, ...]
    """Cameras that were left out, and why."""


def read_calibration(layout: DriveLayout, cameras: tuple[str, ...] | None, *, has_scans: bool) -> Calibration:
    """Read the LiDAR's mounting, if there are scans, and the calibration of the cameras.

    Args:
        layout: The drive's paths.
        cameras: Cameras to read; None = every one with an image folder and a calibration file.
        has_scans: Whether a LiDAR mounting is required.

    Raises:
        CalibrationError: A required file is absent, or a key is missing or damaged.
    """
    wanted, notes = _wanted_cameras(layout, cameras)
    lidar_to_pose = _POSE_FRAME_TO_Z_UP
    is_assumed = not (has_scans or layout.cam_to_velo_path.is_file())
    mountings = KeyedText.read(layout.cam_to_pose_path) if wanted or not is_assumed else None
    if mountings is not None and not is_assumed:
        cam0_to_velo = read_mounting(layout.cam_to_velo_path)
        lidar_to_pose = mountings.mounting("image_00") @ np.linalg.inv(cam0_to_velo)
    found: dict[str, CameraCalibration] = {}
    if mountings is not None:
        has_perspective = any(name in PERSPECTIVE_CAMERAS for name in wanted)
        perspective = KeyedText.read(layout.perspective_path) if has_perspective else None
        found = {name: _read_camera(layout, name, perspective, mountings) for name in wanted}
    return Calibration(
        lidar_to_pose=lidar_to_pose, lidar_is_assumed=is_assumed, cameras=found, notes=tuple(notes)
    )


def read_rectified_camera0_to_pose(layout: DriveLayout) -> np.ndarray | None:
    """(4, 4) rectified camera 0 to pose frame, or None in a drive without `perspective.txt`."""
    if not layout.perspective_path.is_file():
        return None
    perspective = KeyedText.read(layout.perspective_path)
    return _rectified_to_pose(perspective, KeyedText.read(layout.cam_to_pose_path), "image_00")


def read_mei(path: Path) -> MeiFisheye:
    """Read a fisheye calibration (`%YAML:1.0`, as OpenCV writes it; YAML parsers refuse that header).

    Raises:
        CalibrationError: The file is absent or of another camera model, or a key is missing or damaged.
    """
    table = KeyedText.read(path)
    model = table.word("model_type").strip("\"'")
    if model != "MEI":
        raise table.fault(
            "model_type", f"expected the camera model MEI, found {model!r}, whose numbers mean something else"
        )
    names = [field.name for field in fields(MeiFisheye) if field.name not in ("width", "height")]
    values = {name: table.value(name) for name in names}
    width, height = table.value("image_width"), table.value("image_height")
    focal_px, axis_px = (values["gamma1"], values["gamma2"]), (values["u0"], values["v0"])
    fault = intrinsics_fault(focal_px, axis_px, (width, height))
    if fault is not None:
        raise CalibrationError(f"{path}: {fault} (gamma1 and gamma2, u0 and v0); restore the drive's file")
    try:
        return MeiFisheye(**values, width=int(width), height=int(height))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def read_pinhole(table: KeyedText, camera: str) -> Pinhole:
    """The rectified intrinsics of a perspective camera, from the lines of `perspective.txt`.

    Raises:
        CalibrationError: A key is missing, or its value is damaged or unphysical.
    """
    number = camera[-2:]
    # P_rect of camera 1 also has the baseline to camera 0, which the mounting has already.
    projection = table.matrix(f"P_rect_{number}", (3, 4))
    skew = [projection[0, 1], projection[1, 0], *projection[2, :2], projection[2, 2] - 1.0]
    if np.abs(skew).max() > _SKEW_TOLERANCE:
        raise table.fault(
            f"P_rect_{number}",
            "expected a rectified camera's rows (fx 0 cx .), (0 fy cy .), (0 0 1 .), found "
            f"{np.array2string(projection[:, :3], precision=6).replace(chr(10), '')}",
        )
    if np.abs(projection[:, 3]).max() > _LONGEST_BASELINE_M * abs(projection[0, 0]):
        raise table.fault(
            f"P_rect_{number}",
            f"expected a baseline of at most {_LONGEST_BASELINE_M:g} m, found {projection[:, 3]}",
        )
    width, height = table.matrix(f"S_rect_{number}", (2,)).tolist()
    fx, fy, cx, cy = (float(projection[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    fault = intrinsics_fault((fx, fy), (cx, cy), (width, height))
    if fault is not None:
        raise table.fault(f"P_rect_{number}", f"{camera}: {fault} (size: S_rect_{number})")
    return Pinhole(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height))


def _wanted_cameras(layout: DriveLayout, asked: tuple[str, ...] | None) -> tuple[list[str], list[str]]:
    """Names of the cameras to read, and a note on each that was left out."""
    present = [name for name in CAMERAS if require_folder(layout.camera_dir(name))]
    if asked is not None:
        for name in asked:
            if name not in present:
                raise CalibrationError(
                    f"camera {name} was asked for, but there is no folder {layout.camera_dir(name)}; "
                    "take it out of `cameras` in the catalogue or put its images there"
                )
        return list(asked), []
    wanted, notes = [], []
    for name in present:
        path = layout.perspective_path if name in PERSPECTIVE_CAMERAS else layout.fisheye_path(name)
        if path.is_file():
            wanted.append(name)
        else:
            notes.append(f"{name} left out: no calibration file {path}")
    return wanted, notes


def _read_camera(
    layout: DriveLayout, camera: str, perspective: KeyedText | None, mountings: KeyedText
) -> CameraCalibration:
    if perspective is not None and camera in PERSPECTIVE_CAMERAS:
        return CameraCalibration(
            name=camera,
            intrinsics=read_pinhole(perspective, camera),
            to_pose=_rectified_to_pose(perspective, mountings, camera),
        )
    return CameraCalibration(
        name=camera, intrinsics=read_mei(layout.fisheye_path(camera)), to_pose=mountings.mounting(camera)
    )


def _rectified_to_pose(perspective: KeyedText, mountings: KeyedText, camera: str) -> np.ndarray:
    """(4, 4) rectified camera to pose frame."""
    rectification = np.eye(4)
    rectification[:3, :3] = perspective.matrix(f"R_rect_{camera[-2:]}", (3, 3), rotation)
    return np.asarray(mountings.mounting(camera) @ np.linalg.inv(rectification))
