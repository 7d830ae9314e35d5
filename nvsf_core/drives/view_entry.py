"""A view of the catalogue: which sensors, where, at which times; what is impossible is refused when made."""

import itertools
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.drives.kinds import (
    Kinds,
    each,
    is_bool,
    is_number,
    is_path,
    is_text,
    is_whole,
    or_none,
    require_kinds,
    require_name,
    require_range,
)
from nvsf_core.drives.kitti360.layout import CAMERAS
from nvsf_core.drives.view_parts import (
    CAMERA_NAME,
    FARTHEST_SHIFT_M,
    CameraEntry,
    PoseFile,
    SensorEntry,
    Waypoint,
    require_angles,
    require_shift,
)
from nvsf_core.errors import DataError
from nvsf_core.sensors.tables import SENSOR_TABLES

EXPORTS = ("bin", "ply", "pcd", "laz", "kitti", "kitti360", "mcap", "rosbag2", "nuscenes")
"""File formats that the stage `dataset` can write."""
NO_SENSOR = "none"
"""`sensor` of a view without a LiDAR."""
HITS = ("sampled", "threshold")
"""How a data set decides which rays return."""
MEASURED = "measured"
"""`range_noise_m` of a data set with the noise of the drive's own scans."""
PATH_FRAMES = ("start", "world")
"""Frames that given poses can be in."""
_MOST_NOISE_M = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEntry:
    """A synthetic view to render: `[[view]]` of a catalogue."""

    name: str
    """Name of the view; its folder and its `split` in metric tables."""
    scenes: tuple[str, ...] | None = None
    """Scenes that it is rendered of; none = all."""
    sensor: str | SensorEntry | None = None
    """The LiDAR: a known one by its name, one of the catalogue's own `[[sensor]]`, or `none` for images
    alone. None given = the recorded one."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the LiDAR in its own frame: forward, left, up. Cameras move with it."""
    yaw_deg: float = 0.0
    """Turn to the left about the LiDAR's z axis."""
    pitch_deg: float = 0.0
    """Turn downwards, after the yaw."""
    roll_deg: float = 0.0
    """Turn to the right about the way ahead, after the pitch."""
    waypoints: tuple[Waypoint, ...] = ()
    """A smooth path of one's own instead of the recorded one: `{ time_s = 0.0, position_m = [0, 0, 0] }`,
    also with `yaw_deg`, `pitch_deg`, `roll_deg`. Shift and angles of the view come on top."""
    pose_file: PoseFile | None = None
    """The same as a file of poses of the LiDAR, beside the catalogue (in Python and on the command line: in
    the current folder): a line a pose, with 8 numbers (seconds, x y z, quaternion x y z w of length 1) or 13
    (seconds, 3 x 4 matrix row by row)."""
    path_in: str = "start"
    """Frame of `waypoints` or `pose_file`: `start`, the LiDAR's first recorded pose of the scene (forward,
    left, up), or `world`, the drive's own."""
    frames: str | tuple[float, ...] = "all"
    """Recorded frames at whose times the sensors are: `all`, or frame numbers. Or `times_s`, or `rate_hz`."""
    times_s: tuple[float, ...] | None = None
    """Times at which the sensors are, seconds since the scene's first frame, also between frames."""
    rate_hz: float | None = None
    """Sweeps and images a second, from the scene's (or the given path's) first moment to its last."""
    speed: float = 1.0
    """Seconds of the drive that go by in a second of the sensors': 1 as recorded; 0.5 shows all at half
    speed."""
    frozen_at_s: float | None = None
    """Instant of the scene that is shown in all frames or times, seconds since its first frame: all that
    moves is where it was then, also while the LiDAR rotates; the sensors are where they were at their own
    frame or time, and move on as they did. None given = each frame's own instant."""
    cameras: tuple[str, ...] | None = None
    """Recorded cameras to render; `[]` = none. None given = all with the recorded LiDAR or without one, none
    with another LiDAR."""
    camera: tuple[CameraEntry, ...] = ()
    """Cameras of other intrinsics, as `[[view.camera]]`."""
    footprint: bool = False
    """Whether beams have the width that the sensor's table states: the strongest return of five rays
    counts."""
    hits: str = "sampled"
    """Which rays of a data set return: `sampled` by their hit probability, or by `threshold`: those of 0.4
    and more, and one of two neighbours where one of them more likely returns than none."""
    range_noise_m: float | str | None = None
    """Range noise of a data set, one sigma in metres; 0 = off; `measured` = that of the drive's own scans.
    None given = 0.015."""
    exports: tuple[str, ...] = ("bin", "ply")
    """File formats that the stage `dataset` writes."""
    truth: tuple[tuple[str, Path], ...] = ()
    """Cameras, each with the folder of its true images of this view, taken for example by a second camera:
    `{ image_00 = "right_camera" }`; a relative folder lies below the scene's root. They are files named,
    sized and distorted as that camera's recorded ones (PNG or, but for the kind `kitti360`, JPEG); a file's
    number is that of the frame at whose time it was taken, on a path of the view's own, too. Nothing but
    measuring reads them."""

    def __post_init__(self) -> None:
        """Refuse values that would otherwise fail only after training."""
        require_name("name", self.name)
        require_kinds(self, _VIEW_KINDS)
        self._require_times()
        self._require_sensors()
        self._require_path()
        unknown = sorted(set(self.exports) - set(EXPORTS))
        if unknown or len(set(self.exports)) != len(self.exports):
            raise DataError(
                f"exports: expected different ones of {', '.join(EXPORTS)}, found {self.exports!r:.200}"
            )
        require_shift(self.shift_m)
        require_angles(self.yaw_deg, self.pitch_deg, self.roll_deg)
        if self.hits not in HITS:
            raise DataError(f"hits: expected one of {', '.join(HITS)}, found {self.hits!r:.60}")
        if isinstance(self.range_noise_m, str) and self.range_noise_m != MEASURED:
            raise DataError(
                f"range_noise_m: expected metres or {MEASURED!r}, found {self.range_noise_m!r:.60}"
            )
        if isinstance(self.range_noise_m, int | float):
            require_range("range_noise_m", self.range_noise_m, 0.0, _MOST_NOISE_M, "m")
        self._require_truth()

    @property
    def is_on_recorded_path(self) -> bool:
        """Whether the sensors follow the recorded path, but for shift and angles."""
        return not self.waypoints and self.pose_file is None

    @property
    def sensor_name(self) -> str | None:
        """Name of the LiDAR that is asked for; None = the recorded one."""
        return self.sensor.name if isinstance(self.sensor, SensorEntry) else self.sensor

    @property
    def own_rate_hz(self) -> float | None:
        """Rotations a second of the LiDAR that is asked for; None = those of the recorded one."""
        if isinstance(self.sensor, SensorEntry):
            return self.sensor.rate_hz
        return None if self.sensor in (None, NO_SENSOR) else SENSOR_TABLES[self.sensor].rate_hz

    def _require_times(self) -> None:
        given = [
            name
            for name, is_given in (
                ("frames", self.frames not in ("all", ())), ("times_s", self.times_s is not None),
                ("rate_hz", self.rate_hz is not None),
            )
            if is_given
        ]  # fmt: skip
        if len(given) > 1:
            raise DataError(
                f"expected one of frames, times_s, rate_hz, found {' and '.join(given)}; leave one"
            )
        if not given and self.frames == ():
            raise DataError("frames: expected frames or times, found none")
        if self.rate_hz is not None:
            require_range("rate_hz", self.rate_hz, 0.1, 1000.0, "a second")
        require_range("speed", self.speed, 0.01, 100.0, "seconds of the drive in one of the sensors'")
        if self.times_s is not None and any(b <= a for a, b in itertools.pairwise(self.times_s)):
            raise DataError(
                f"times_s: expected ascending times, each once, found {self.times_s!r:.200}; sort them"
            )
        instants = self.frames if self.times_s is None else self.times_s
        if instants != "all" and len(set(instants)) != len(instants):
            raise DataError(f"frames: expected each frame or time once, found {instants!r:.200}")

    def _require_sensors(self) -> None:
        name = self.sensor_name
        if isinstance(self.sensor, str) and name not in SENSOR_TABLES and name != NO_SENSOR:
            raise DataError(
                f"sensor: expected one of {', '.join(SENSOR_TABLES)}, a [[sensor]] of the catalogue, or "
                f"{NO_SENSOR!r}, found {name!r:.60}"
            )
        unknown = [name for name in self.cameras or () if not CAMERA_NAME.fullmatch(name)]
        if unknown or len(set(self.cameras or ())) != len(self.cameras or ()):
            raise DataError(
                f"cameras: expected different recorded ones, as {CAMERAS[0]}, found {self.cameras!r:.200}; "
                "one of other intrinsics is a [[view.camera]]"
            )
        own = [camera.name for camera in self.camera]
        if len(set(own)) != len(own):
            raise DataError(f"camera: expected different names, found {own!r:.200}")
        if name == NO_SENSOR and self.cameras == () and not self.camera:
            raise DataError("expected a LiDAR or a camera, found `sensor` none and no `cameras`; name one")
        if self.footprint and name == NO_SENSOR:
            raise DataError("footprint: expected a LiDAR, found `sensor` none")
        if self.footprint and name is not None:
            table = self.sensor.table() if isinstance(self.sensor, SensorEntry) else SENSOR_TABLES[name]
            if table.divergence_mrad == 0.0:
                raise DataError(
                    f"footprint: the beam width of {name} is not known; give it as `divergence_mrad` of a "
                    "[[sensor]] of your own"
                )

    def _require_path(self) -> None:
        if self.waypoints and self.pose_file is not None:
            raise DataError("expected `waypoints` or `pose_file`, found both; leave one out")
        if self.path_in not in PATH_FRAMES:
            raise DataError(f"path_in: expected one of {', '.join(PATH_FRAMES)}, found {self.path_in!r:.60}")
        times_s = [point.time_s for point in self.waypoints]
        if any(after <= before for before, after in itertools.pairwise(times_s)):
            raise DataError(f"waypoints: expected ascending time_s, found {times_s!r:.200}")
        if self.path_in == "start":
            poses = () if self.pose_file is None else self.pose_file.poses
            places_m = [*(point.position_m for point in self.waypoints), *(row[3::4] for row in poses)]
            for place_m in places_m:
                if not all(abs(value) <= FARTHEST_SHIFT_M for value in place_m):
                    raise DataError(
                        f"{'waypoints' if self.waypoints else 'pose_file'}: expected positions within "
                        f"{FARTHEST_SHIFT_M:g} m of the start, found {place_m}; places in the drive's world "
                        'need `path_in = "world"`'
                    )

    def _require_truth(self) -> None:
        cameras = [camera for camera, _ in self.truth]
        if not all(map(CAMERA_NAME.fullmatch, cameras)) or len(set(cameras)) != len(cameras):
            raise DataError(f"truth: expected different cameras, as {CAMERAS[0]}, found {cameras!r:.200}")
        if cameras and (self.times_s is not None or self.rate_hz is not None):
            raise DataError("truth: expected a view of frames, found times; true images are named by frames")
        if cameras and self.sensor is not None and self.cameras is None:
            raise DataError(
                f"truth: a view by {self.sensor_name} has no images to compare; leave `sensor` out, or name "
                "`cameras`"
            )


_VIEW_KINDS: Kinds = {
    "scenes": (or_none(each(is_text)), "names of scenes, or None for all"),
    "sensor": (
        or_none(lambda value: is_text(value) or isinstance(value, SensorEntry)),
        "a sensor's name, or None for the recorded one",
    ),
    "shift_m": (each(is_number, 3, 3), "three numbers: forward, left, up"),
    "yaw_deg": (is_number, "a number of degrees"),
    "pitch_deg": (is_number, "a number of degrees"),
    "roll_deg": (is_number, "a number of degrees"),
    "waypoints": (each(lambda one: isinstance(one, Waypoint), 0), "a tuple of Waypoint"),
    "pose_file": (or_none(lambda one: isinstance(one, PoseFile)), "a PoseFile, or None"),
    "path_in": (is_text, f"one of {', '.join(PATH_FRAMES)}"),
    "frames": (
        lambda value: value == "all" or each(is_whole, 0)(value),
        '"all" or frame numbers, as [3, 4]; moments between frames are `times_s`',
    ),
    "times_s": (or_none(each(is_number)), "a tuple of seconds, or None"),
    "rate_hz": (or_none(is_number), "a number a second, or None"),
    "speed": (is_number, "a number"),
    "frozen_at_s": (or_none(is_number), "seconds since the scene's first frame, or None"),
    "cameras": (or_none(each(is_text, 0)), "names of cameras, or None"),
    "camera": (each(lambda one: isinstance(one, CameraEntry), 0, 32), "a tuple of CameraEntry"),
    "footprint": (is_bool, "true or false"),
    "hits": (is_text, f"one of {', '.join(HITS)}"),
    "range_noise_m": (
        or_none(lambda value: is_number(value) or is_text(value)), f"metres, {MEASURED!r}, or None",
    ),
    "exports": (each(is_text), "a tuple of formats"),
    "truth": (
        each(
            lambda one: isinstance(one, tuple) and len(one) == 2 and is_text(one[0]) and is_path(one[1]), 0
        ),
        "a tuple of cameras, each with a Path",
    ),
}  # fmt: skip
