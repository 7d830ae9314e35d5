"""Intrinsics and mounting of the cameras and the LiDAR, read from KITTI-360's calibration files.

Frames: the pose frame (x forward, y right, z down) is the one that `poses.txt` places in the world;
the LiDAR has x forward, y left, z up; a camera x right, y down, z forward. The files speak of
unrectified cameras; a perspective image is rectified: `x_rectified = R_rect x_camera`.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from nvsf_core.errors import CalibrationError
from nvsf_core.kitti360.layout import CAMERAS, PERSPECTIVE_CAMERAS, DriveLayout

_ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of `R R^T - 1` that still passes as a rotation printed with few digits."""

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
    if not is_assumed:
        cam0_to_pose = _mounting(layout, "image_00")
        cam0_to_velo = _read_single_matrix(layout.cam_to_velo_path)
        lidar_to_pose = cam0_to_pose @ np.linalg.inv(cam0_to_velo)
    return Calibration(
        lidar_to_pose=lidar_to_pose,
        lidar_is_assumed=is_assumed,
        cameras={name: _read_camera(layout, name) for name in wanted},
        notes=tuple(notes),
    )


def read_rectified_camera0_to_pose(layout: DriveLayout) -> np.ndarray | None:
    """Rectified camera 0 to pose frame (4, 4), or None in a drive without `perspective.txt`."""
    if not layout.perspective_path.is_file():
        return None
    return _rectified_to_pose(layout, "image_00")


def read_mei(path: Path) -> MeiIntrinsics:
    """Read a fisheye calibration (`%YAML:1.0`, as OpenCV writes it: no YAML parser takes that header).

    Raises:
        CalibrationError: The file is absent, lacks a key, or garbles a value.
    """
    table = _read_keyed(path)
    sizes = {name: int(_value(table, path, f"image_{name}")) for name in ("width", "height")}
    names = [field.name for field in fields(MeiIntrinsics) if field.name not in sizes]
    return MeiIntrinsics(**sizes, **{name: _value(table, path, name) for name in names})  # type: ignore[arg-type]


def read_pinhole(path: Path, camera: str) -> PinholeIntrinsics:
    """Read the rectified intrinsics of a perspective camera from `perspective.txt`.

    Raises:
        CalibrationError: The file is absent, lacks a key, or garbles a value.
    """
    table = _read_keyed(path)
    number = camera[-2:]
    # P_rect of camera 1 also holds the baseline to camera 0; the pose chain has it already.
    projection = _matrix(table, path, f"P_rect_{number}", (3, 4))
    width, height = _matrix(table, path, f"S_rect_{number}", (2,))
    if projection[0, 0] <= 0 or projection[1, 1] <= 0 or width < 1 or height < 1:
        raise CalibrationError(
            f"{path}: expected positive focal lengths and sizes for {camera}, found fx {projection[0, 0]}, "
            f"fy {projection[1, 1]}, size {width} x {height}; restore the file of the drive"
        )
    return PinholeIntrinsics(
        width=int(width),
        height=int(height),
        fx=float(projection[0, 0]),
        fy=float(projection[1, 1]),
        cx=float(projection[0, 2]),
        cy=float(projection[1, 2]),
    )


def parse_numbers(text: str, count: int) -> np.ndarray:
    """Exactly `count` finite numbers separated by blanks, as float64.

    Raises:
        ValueError: Another count, no number, or not finite; the message says which.
    """
    words = text.split()
    if len(words) != count:
        raise ValueError(f"expected {count} numbers, found {len(words)}")
    values = np.array([float(word) for word in words])
    if not np.isfinite(values).all():
        raise ValueError("expected finite numbers, found NaN or infinity")
    return values


def rigid(values: np.ndarray) -> np.ndarray:
    """A (3, 4) block as a (4, 4) rigid transform.

    Raises:
        ValueError: Its 3x3 part is no rotation.
    """
    matrix = np.eye(4)
    matrix[:3] = values.reshape(3, 4)
    _require_rotation(matrix[:3, :3])
    return matrix


def _require_rotation(rotation: np.ndarray) -> None:
    deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if deviation > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(f"expected a rotation, found a matrix with |R R^T - 1| up to {deviation:.3g}")


def _wanted_cameras(layout: DriveLayout, asked: tuple[str, ...] | None) -> tuple[list[str], list[str]]:
    notes: list[str] = []
    present = [name for name in CAMERAS if layout.camera_dir(name).is_dir()]
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


def _read_camera(layout: DriveLayout, camera: str) -> CameraCalibration:
    if camera in PERSPECTIVE_CAMERAS:
        return CameraCalibration(
            name=camera,
            intrinsics=read_pinhole(layout.perspective_path, camera),
            to_pose=_rectified_to_pose(layout, camera),
        )
    return CameraCalibration(
        name=camera, intrinsics=read_mei(layout.fisheye_path(camera)), to_pose=_mounting(layout, camera)
    )


def _rectified_to_pose(layout: DriveLayout, camera: str) -> np.ndarray:
    path = layout.perspective_path
    key = f"R_rect_{camera[-2:]}"
    rectification = np.eye(4)
    rectification[:3, :3] = _matrix(_read_keyed(path), path, key, (3, 3))
    try:
        _require_rotation(rectification[:3, :3])
    except ValueError as error:
        raise CalibrationError(f"{path}, {key}: {error}; restore the file of the drive") from error
    return _mounting(layout, camera) @ np.linalg.inv(rectification)


def _mounting(layout: DriveLayout, camera: str) -> np.ndarray:
    """Unrectified camera to pose frame."""
    path = layout.cam_to_pose_path
    values = _matrix(_read_keyed(path), path, camera, (3, 4))
    try:
        return rigid(values)
    except ValueError as error:
        raise CalibrationError(f"{path}, {camera}: {error}; restore the file of the drive") from error


def _read_single_matrix(path: Path) -> np.ndarray:
    try:
        return rigid(parse_numbers(_read_text(path), 12))
    except ValueError as error:
        raise CalibrationError(f"{path}, line 1: {error}; restore the file of the drive") from error


_Keyed = dict[str, tuple[int, str]]


def _read_keyed(path: Path) -> _Keyed:
    """Lines `key: value` as key to (line number, value); nesting and a leading % directive are ignored."""
    table: _Keyed = {}
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        key, colon, value = line.strip().partition(":")
        if colon and not key.startswith("%"):
            table[key.strip()] = (number, value.strip())
    return table


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"cannot read calibration file {path} ({error}); unpack the drive's `calibration` folder there"
        ) from error


def _matrix(table: _Keyed, path: Path, key: str, shape: tuple[int, ...]) -> np.ndarray:
    if key not in table:
        raise CalibrationError(
            f"{path}: key {key!r} is missing (found {', '.join(sorted(table)) or 'no keys'}); "
            "restore the file of the drive, or name the cameras to use in the catalogue"
        )
    line, text = table[key]
    try:
        return parse_numbers(text, int(np.prod(shape))).reshape(shape)
    except ValueError as error:
        raise CalibrationError(f"{path}, line {line}, {key}: {error}; restore the drive's file") from error


def _value(table: _Keyed, path: Path, key: str) -> float:
    return float(_matrix(table, path, key, (1,))[0])
