"""Intrinsics and mounting of the cameras and the LiDAR, read from KITTI-360's calibration files.

Frames: the pose frame (x forward, y right, z down) is the one that `poses.txt` places in the world;
the LiDAR has x forward, y left, z up; a camera x right, y down, z forward. The files speak of
unrectified cameras; a perspective image is rectified: `x_rectified = R_rect x_camera`.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.layout import CAMERAS, PERSPECTIVE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.text import KeyedText, read_mounting, require_folder, rotation
from nvsf_core.errors import CalibrationError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import intrinsics_fault

_SKEW_TOLERANCE = 1e-9
"""A rectified camera has neither skew nor turn in its projection."""

_LONGEST_BASELINE_M = 10.0
"""Between two cameras of one car."""

_POSE_FRAME_TO_Z_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""LiDAR axes placed at the pose frame's origin: what stands in for a LiDAR in a camera-only drive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeIntrinsics:
    """A rectified perspective camera, in pixels; pixel centres lie at integers (KITTI's P_rect)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MeiIntrinsics:
    """A fisheye camera after Mei: unit sphere shifted by xi, radial and tangential distortion."""

    width: int
    height: int
    xi: float
    k1: float
    k2: float
    p1: float
    p2: float
    gamma1: float
    gamma2: float
    u0: float
    v0: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCalibration:
    """One camera: how it maps rays to pixels and where it is mounted."""

    name: str
    intrinsics: PinholeIntrinsics | MeiIntrinsics
    to_pose: np.ndarray
    """(4, 4) float64: the camera that took the stored image (rectified if perspective) to pose frame."""

    @property
    def kind(self) -> str:
        """`perspective` or `fisheye`."""
        return "perspective" if isinstance(self.intrinsics, PinholeIntrinsics) else "fisheye"

    def facts(self) -> dict[str, float | int | str]:
        """Kind and intrinsics as plain JSON values."""
        values = {field.name: getattr(self.intrinsics, field.name) for field in fields(self.intrinsics)}
        return {"kind": self.kind, **values}


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Everything that is mounted on the car."""

    lidar_to_pose: np.ndarray
    """(4, 4) float64: LiDAR to pose frame."""
    lidar_is_assumed: bool
    """True where no file places a LiDAR: it then stands at the pose frame's origin."""
    cameras: dict[str, CameraCalibration]
    notes: tuple[str, ...]
    """What was left out, and why."""


def read_calibration(layout: DriveLayout, cameras: tuple[str, ...] | None, *, has_scans: bool) -> Calibration:
    """Read what the drive's sensors need: LiDAR mounting if there are scans, and its cameras.

    Args:
        layout: The drive's paths.
        cameras: Cameras that were asked for; None = every one with an image folder and a calibration file.
        has_scans: Whether a LiDAR mounting is required.

    Raises:
        CalibrationError: A needed file is absent, lacks a key, or garbles a value.
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
    """Rectified camera 0 to pose frame (4, 4), or None in a drive without `perspective.txt`."""
    if not layout.perspective_path.is_file():
        return None
    perspective = KeyedText.read(layout.perspective_path)
    return _rectified_to_pose(perspective, KeyedText.read(layout.cam_to_pose_path), "image_00")


def read_mei(path: Path) -> MeiIntrinsics:
    """Read a fisheye calibration (`%YAML:1.0`, as OpenCV writes it: no YAML parser takes that header).

    Raises:
        CalibrationError: The file is absent, of another camera model, lacks a key, or garbles a value.
    """
    table = KeyedText.read(path)
    model = table.word("model_type").strip("\"'")
    if model != "MEI":
        raise table.fault(
            "model_type", f"expected the camera model MEI, found {model!r}, whose numbers mean something else"
        )
    names = [field.name for field in fields(MeiIntrinsics) if field.name not in ("width", "height")]
    values = {name: table.value(name) for name in names}
    width, height = table.value("image_width"), table.value("image_height")
    focal_px, axis_px = (values["gamma1"], values["gamma2"]), (values["u0"], values["v0"])
    fault = intrinsics_fault(focal_px, axis_px, (width, height))
    if fault is not None:
        raise CalibrationError(f"{path}: {fault} (gamma1 and gamma2, u0 and v0); restore the drive's file")
    try:
        MeiFisheye(**values, width=int(width), height=int(height))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    return MeiIntrinsics(width=int(width), height=int(height), **values)


def read_pinhole(table: KeyedText, camera: str) -> PinholeIntrinsics:
    """The rectified intrinsics of a perspective camera, of the lines of `perspective.txt`.

    Raises:
        CalibrationError: A key is missing, or its value garbled or unphysical.
    """
    number = camera[-2:]
    # P_rect of camera 1 also holds the baseline to camera 0; the pose chain has it already.
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
    return PinholeIntrinsics(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)


def _wanted_cameras(layout: DriveLayout, asked: tuple[str, ...] | None) -> tuple[list[str], list[str]]:
    notes: list[str] = []
    present = [name for name in CAMERAS if require_folder(layout.camera_dir(name))]
    if asked is not None:
        for name in asked:
            if name not in present:
                raise CalibrationError(
                    f"camera {name} was asked for, but there is no folder {layout.camera_dir(name)}; "
                    "take it out of `cameras` in the catalogue or put its images there"
                )
        return list(asked), notes
    wanted = []
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
    key = f"R_rect_{camera[-2:]}"
    rectification = np.eye(4)
    try:
        rectification[:3, :3] = rotation(perspective.matrix(key, (3, 3)))
    except ValueError as error:
        raise perspective.fault(key, str(error)) from error
    return np.asarray(mountings.mounting(camera) @ np.linalg.inv(rectification))
