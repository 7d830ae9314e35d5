"""Parts of a view's entry that are tables of their own: sensors, cameras, waypoints, poses of a file."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.drives.kinds import (
    Kinds,
    each,
    is_number,
    is_text,
    is_whole,
    or_none,
    require_kinds,
    require_name,
    require_range,
)
from nvsf_core.drives.kitti360.layout import CAMERAS
from nvsf_core.errors import DataError
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.sensors.tables import SENSOR_TABLES, LaserTable, even_table

FARTHEST_SHIFT_M = 1000.0
"""From farther away nothing of a street is visible."""
MOST_DEG = 360.0
_MOST_LASERS = 512
_CAMERA_NAME = re.compile(r"image_\d\d")
CAMERA_NAME = re.compile(r"[a-z][a-z0-9]*(?:_[a-z0-9]+)*", re.ASCII)
"""Names of recorded cameras: part of folders and of arrays' names."""
_MOST_PIXELS = 8192
_MOST_TILT_DEG = 60.0
"""Steeper is no road: a LiDAR that lies on its side or head is named."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorEntry:
    """A rotating LiDAR of one's own: `[[sensor]]` of a catalogue; views ask for it by its name."""

    name: str
    """Its name; not that of a known table."""
    elevation_deg: tuple[float, ...]
    """Elevation of each laser, degrees, from the top downwards."""
    vertical_offset_m: tuple[float, ...] = ()
    """Lever arm of each laser across its ray, upwards, metres; none = 0."""
    horizontal_offset_m: tuple[float, ...] = ()
    """Lever arm of each laser across its ray, to the left, metres; none = 0."""
    azimuth_step_deg: float = 0.2
    """Angle from firing to firing, degrees; a full rotation holds a whole number of steps."""
    rate_hz: float | None = None
    """Rotations a second; none = those of the recorded LiDAR."""
    max_range_m: float = 100.0
    """Beyond this it records nothing; nor does it beyond the greatest range of the LiDAR that recorded the
    drive."""
    divergence_mrad: float = 0.0
    """Full angle of a beam, milliradians; 0 = a ray without width. A view uses it with `footprint = true`."""

    def __post_init__(self) -> None:
        """Refuse values that no such sensor has."""
        require_name("name", self.name)
        require_kinds(self, _SENSOR_KINDS)
        if self.name in SENSOR_TABLES or self.name == "none":
            raise DataError(f"name: {self.name!r} is the name of a known sensor; choose another")
        if not all(abs(angle) <= 90.0 for angle in self.elevation_deg):
            raise DataError(f"elevation_deg: expected -90 to 90 degrees, found {self.elevation_deg!r:.200}")
        if any(np.diff(self.elevation_deg) > 0.0):
            raise DataError("elevation_deg: expected lasers from the top downwards; sort them")
        for name in ("vertical_offset_m", "horizontal_offset_m"):
            offsets = getattr(self, name)
            if offsets and len(offsets) != len(self.elevation_deg):
                raise DataError(
                    f"{name}: expected one for each of the {len(self.elevation_deg)} lasers, or none, found "
                    f"{len(offsets)}"
                )
            if not all(abs(offset) <= 1.0 for offset in offsets):
                raise DataError(f"{name}: expected at most 1 m, found {offsets!r:.200}")
        require_range("azimuth_step_deg", self.azimuth_step_deg, 0.02, 10.0, "degrees")
        if self.rate_hz is not None:
            require_range("rate_hz", self.rate_hz, 1.0, 100.0, "rotations a second")
        require_range("max_range_m", self.max_range_m, 1.0, 1000.0, "m")
        require_range("divergence_mrad", self.divergence_mrad, 0.0, 50.0, "mrad")

    def table(self) -> LaserTable:
        """The sensor as a table of lasers."""
        return even_table(
            self.name, np.array(self.elevation_deg), firings=round(360.0 / self.azimuth_step_deg),
            max_range_m=float(self.max_range_m), rate_hz=self.rate_hz, divergence_mrad=self.divergence_mrad,
            vertical_offset_m=np.array(self.vertical_offset_m or [0.0] * len(self.elevation_deg)),
            horizontal_offset_m=np.array(self.horizontal_offset_m or [0.0] * len(self.elevation_deg)),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEntry:
    """A camera of other intrinsics: `[[view.camera]]` of a catalogue.

    It is rendered by images of the recorded camera `like` from the same place, so its detail is theirs.
    """

    name: str
    """`image_04` to `image_99`."""
    like: str
    """The recorded camera whose place and colours it has."""
    width: int
    """Columns."""
    height: int
    """Rows."""
    focal_px: float | None = None
    """Focal length of a pinhole camera, pixels; none for a fisheye."""
    cx: float | None = None
    """Column of its principal point; none = the image's middle. Pixel centres lie at whole numbers."""
    cy: float | None = None
    """Row of its principal point; none = the image's middle."""
    mei: tuple[tuple[str, float], ...] = ()
    """A fisheye by the MEI model, as KITTI-360 has it: `{ xi, k1, k2, p1, p2, gamma1, gamma2, u0, v0 }`."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift from the place of `like`: forward, left, up in the LiDAR's axes."""
    yaw_deg: float = 0.0
    """Turn to the left about its own place, in the LiDAR's axes."""
    pitch_deg: float = 0.0
    """Turn downwards."""
    roll_deg: float = 0.0
    """Turn to the right about the way ahead."""

    def __post_init__(self) -> None:
        """Refuse values that no camera has."""
        require_kinds(self, _CAMERA_KINDS)
        if not _CAMERA_NAME.fullmatch(self.name) or self.name in CAMERAS:
            raise DataError(f"name: expected image_04 to image_99, found {self.name!r:.60}")
        if not CAMERA_NAME.fullmatch(self.like):
            raise DataError(f"like: expected a recorded camera, as {CAMERAS[0]}, found {self.like!r:.60}")
        for what, size in (("width", self.width), ("height", self.height)):
            require_range(what, size, 8, _MOST_PIXELS, "pixels")
        if bool(self.mei) == (self.focal_px is not None):
            raise DataError("expected `focal_px` (a pinhole) or `mei` (a fisheye), one of them; found "
                            f"{'both' if self.mei else 'neither'}")  # fmt: skip
        require_angles(self.yaw_deg, self.pitch_deg, self.roll_deg)
        require_shift(self.shift_m)
        if self.mei and {name for name, _ in self.mei} != set(_MEI_NAMES):
            raise DataError(f"mei: expected {', '.join(_MEI_NAMES)}, found {dict(self.mei)!r:.200}")
        self.model()

    def model(self) -> Pinhole | MeiFisheye:
        """Its camera model.

        Raises:
            CalibrationError: The values are unphysical.
        """
        if self.mei:
            return MeiFisheye(**dict(self.mei), width=self.width, height=self.height)
        assert self.focal_px is not None
        cx = (self.width - 1) / 2 if self.cx is None else self.cx
        cy = (self.height - 1) / 2 if self.cy is None else self.cy
        return Pinhole(
            float(self.focal_px), float(self.focal_px), float(cx), float(cy), self.width, self.height
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """One pose of a smooth path: an item of a view's `waypoints`."""

    time_s: float
    """Moment at which the LiDAR is there, seconds since the scene's first frame."""
    position_m: tuple[float, float, float]
    """Where: forward, left, up of the LiDAR's first recorded pose; or in the world (`path_in`)."""
    yaw_deg: float = 0.0
    """Turn to the left."""
    pitch_deg: float = 0.0
    """Turn downwards."""
    roll_deg: float = 0.0
    """Turn to the right about the way ahead."""

    def __post_init__(self) -> None:
        """Refuse values of other kinds."""
        require_kinds(self, _WAYPOINT_KINDS)
        require_angles(self.yaw_deg, self.pitch_deg, self.roll_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseFile:
    """The poses of a file: a view's `pose_file`."""

    name: str
    """Name of the file, for messages."""
    time_s: tuple[float, ...]
    """(n,) seconds since the scene's first frame, ascending."""
    poses: tuple[tuple[float, ...], ...]
    """(n,) upper three rows of each pose (3 x 4, row by row), LiDAR to the frame `path_in`, metres."""


def tilted_words(poses: Sequence[Sequence[float]]) -> str:
    """How far the poses of a file turn the LiDAR over, as quaternions in another order do; else empty.

    `poses` (n, 12) are those of a `PoseFile`.
    """
    up = np.array(poses, np.float64).reshape(-1, 3, 4)[:, 2, 2]
    tilt_deg = float(np.degrees(np.arccos(np.clip(up.min(), -1.0, 1.0))))
    if tilt_deg <= _MOST_TILT_DEG:
        return ""
    return f"the LiDAR is up to {tilt_deg:.0f} degrees off upright (quaternions are x, y, z, w)"


_MEI_NAMES = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0")
_SENSOR_KINDS: Kinds = {
    "elevation_deg": (each(is_number, 1, _MOST_LASERS), f"1 to {_MOST_LASERS} angles, from the top"),
    "vertical_offset_m": (each(is_number, 0, _MOST_LASERS), "a tuple of metres"),
    "horizontal_offset_m": (each(is_number, 0, _MOST_LASERS), "a tuple of metres"),
    "azimuth_step_deg": (is_number, "a number of degrees"),
    "rate_hz": (or_none(is_number), "rotations a second, or None"),
    "max_range_m": (is_number, "a number of metres"),
    "divergence_mrad": (is_number, "a number of milliradians"),
}
_TURNS: Kinds = dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg"), (is_number, "a number of degrees"))
_CAMERA_KINDS: Kinds = {
    "name": (is_text, "a camera's name, as image_10"),
    "like": (is_text, "a recorded camera's name, as image_00"),
    "width": (is_whole, "a whole number of pixels"),
    "height": (is_whole, "a whole number of pixels"),
    "focal_px": (or_none(is_number), "pixels, or None"),
    "cx": (or_none(is_number), "pixels, or None"),
    "cy": (or_none(is_number), "pixels, or None"),
    "mei": (
        each(lambda one: isinstance(one, tuple) and len(one) == 2 and is_number(one[1]), 0, 20),
        "a table of numbers",
    ),
    "shift_m": (each(is_number, 3, 3), "three numbers: forward, left, up"),
    **_TURNS,
}
_WAYPOINT_KINDS: Kinds = {
    "time_s": (is_number, "seconds since the scene's first frame"),
    "position_m": (each(is_number, 3, 3), "three numbers"),
    **_TURNS,
}


def require_angles(yaw_deg: float, pitch_deg: float, roll_deg: float) -> None:
    """Refuse turns beyond a full circle.

    Raises:
        DataError: There is one.
    """
    for name, angle in (("yaw_deg", yaw_deg), ("pitch_deg", pitch_deg), ("roll_deg", roll_deg)):
        if not abs(angle) <= MOST_DEG:
            raise DataError(f"{name}: expected -{MOST_DEG:g} to {MOST_DEG:g}, found {angle}")


def require_shift(shift_m: tuple[float, float, float]) -> None:
    """Refuse shifts that see nothing of the scene.

    Raises:
        DataError: It is too long.
    """
    if not all(abs(value) <= FARTHEST_SHIFT_M for value in shift_m):
        raise DataError(
            f"shift_m: expected at most {FARTHEST_SHIFT_M:g} m in each direction, found {shift_m}"
        )
