"""Entries of the catalogue, scenes and views; impossible values are refused when an entry is made."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.drives.kitti360.layout import CAMERAS, LAST_FRAME
from nvsf_core.drives.kitti360.timestamps import LONGEST_STEP_S, SHORTEST_STEP_S
from nvsf_core.errors import DataError, RecipeError
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.recipe import preset
from nvsf_core.sensors.tables import SENSOR_TABLES

EXPORTS = ("bin", "ply", "pcd")
"""File formats that the stage `dataset` can write."""
MOST_FRAMES = 20_000
"""Most frames of one scene: half an hour. KITTI-360's longest drive has 15,000."""
FARTHEST_SHIFT_M = 1000.0
"""From farther away nothing of a street is visible."""
_MOST_YAW_DEG = 360.0
_LARGEST = 1e15
"""Largest number in a catalogue."""
_LONGEST_PATH = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEntry:
    """A synthetic view to render: `[[view]]` of a catalogue."""

    name: str
    """Name of the view; its folder and its `split` in metric tables."""
    scenes: tuple[str, ...] | None = None
    """Scenes that it is rendered of; None = all."""
    sensor: str | None = None
    """Name of a sensor table (`HDL-64E`, `VLP-16`, `OS1-128`); None = the recorded one."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the LiDAR in its own frame: forward, left, up."""
    yaw_deg: float = 0.0
    """Turn to the left about the LiDAR's z axis."""
    frames: str | tuple[float, ...] = "all"
    """`all`, frame numbers, or nothing if `times_s` are given."""
    times_s: tuple[float, ...] | None = None
    """Times since the drive's first frame, also between frames; None = use `frames`."""
    frozen_at_s: float | None = None
    """Instant of the scene that is shown in all frames or times, seconds since its first frame: all that
    moves is where it was then, also while the LiDAR rotates; the sensors are where they were at their own
    frame or time, and move on as they did. None = each frame's own instant."""
    exports: tuple[str, ...] = ("bin", "ply")
    """File formats that the stage `dataset` writes: some of `EXPORTS`."""
    truth: tuple[tuple[str, Path], ...] = ()
    """Cameras, each with the folder of its true images of this view, taken for example by a second camera. In
    a catalogue `truth = { image_00 = "right_camera" }`; a relative folder lies below the scene's root. They
    are PNG files named, sized and distorted as that camera's recorded ones, of the view's frames; nothing but
    measuring reads them."""

    def __post_init__(self) -> None:
        """Refuse values that would otherwise fail only after training."""
        _require_name("name", self.name)
        _require_kinds(self, _VIEW_KINDS)
        if self.times_s is None and self.frames == ():
            raise DataError("frames: expected frames or times, found none")
        if self.sensor is not None and self.sensor not in SENSOR_TABLES:
            raise DataError(f"sensor: expected one of {', '.join(SENSOR_TABLES)}, found {self.sensor!r:.60}")
        unknown = sorted(set(self.exports) - set(EXPORTS))
        if unknown or len(set(self.exports)) != len(self.exports):
            raise DataError(
                f"exports: expected different ones of {', '.join(EXPORTS)}, found {self.exports!r:.200}"
            )
        if not all(abs(value) <= FARTHEST_SHIFT_M for value in self.shift_m):
            raise DataError(
                f"shift_m: expected at most {FARTHEST_SHIFT_M:g} m in each direction, found {self.shift_m}"
            )
        if not abs(self.yaw_deg) <= _MOST_YAW_DEG:
            raise DataError(
                f"yaw_deg: expected -{_MOST_YAW_DEG:g} to {_MOST_YAW_DEG:g}, found {self.yaw_deg}"
            )
        instants = self.frames if self.times_s is None else self.times_s
        if instants != "all" and len(set(instants)) != len(instants):
            raise DataError(f"frames: expected each frame or time once, found {instants!r:.200}")
        self._require_truth()

    def _require_truth(self) -> None:
        cameras = [camera for camera, _ in self.truth]
        if not set(cameras) <= set(CAMERAS) or len(set(cameras)) != len(cameras):
            raise DataError(f"truth: expected different ones of {', '.join(CAMERAS)}, found {cameras!r:.200}")
        if cameras and self.times_s is not None:
            raise DataError("truth: expected a view of frames, found times; true images are named by frames")
        if cameras and self.sensor is not None:
            raise DataError(f"truth: a view by {self.sensor} has no images to compare; leave `sensor` out")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneEntry:
    """A section of a drive: `[[scene]]` of a catalogue."""

    name: str
    """Name of the scene; Dagster's partition key."""
    root: Path
    """KITTI-360 root that holds `data_3d_raw`, `data_2d_raw`, `data_poses`, `calibration`."""
    sequence: str
    """Name of the drive, for example `2013_05_28_drive_0000_sync`."""
    first_frame: int
    """First frame number, inclusive."""
    last_frame: int
    """Last frame number, inclusive."""
    test_frames: tuple[int, ...]
    """Test frames: never trained on, never used to choose anything."""
    sweep_period_s: float | None = None
    """Duration of a LiDAR sweep if there are no timestamps; stored as assumed."""
    cameras: tuple[str, ...] | None = None
    """Cameras to use; None = every camera present and calibrated."""
    recipe: str | None = None
    """Recipe if a run names none."""
    compensate: bool = True
    """Ego-motion compensation: each return is placed by the sensor's pose at its own time. False = one pose
    for a whole sweep, as papers do."""
    views: tuple[ViewEntry, ...] = ()
    """The views that apply to this scene."""

    def __post_init__(self) -> None:
        """Refuse values that would otherwise fail only later, or write outside the scene's folder."""
        _require_name("name", self.name, RESERVED_SCENES)
        _require_name("sequence", self.sequence)
        _require_kinds(self, _SCENE_KINDS)
        self._require_frames()
        if self.sweep_period_s is not None and not SHORTEST_STEP_S <= self.sweep_period_s <= LONGEST_STEP_S:
            raise DataError(
                f"sweep_period_s: expected {SHORTEST_STEP_S:g} to {LONGEST_STEP_S:g} seconds of one sweep, "
                f"found {self.sweep_period_s}"
            )
        unknown = [name for name in self.cameras or () if name not in CAMERAS]
        if unknown or len(set(self.cameras or ())) != len(self.cameras or ()):
            raise DataError(
                f"cameras: expected different ones of {', '.join(CAMERAS)}, found {self.cameras!r:.200}"
            )
        if self.recipe is not None:
            try:
                preset(self.recipe)
            except RecipeError as error:
                raise DataError(f"recipe: {error}") from error

        self._require_views()

    def _require_views(self) -> None:
        names = [view.name.casefold() for view in self.views]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise DataError(
                f"scene {self.name}: views: expected each name once, upper or lower case, found {twice[0]!r} "
                "again; rename one"
            )
        for view in self.views:
            absent = [name for name, _ in view.truth if name not in (self.cameras or CAMERAS)]
            if absent:
                raise DataError(
                    f"view {view.name}: truth: expected cameras that scene {self.name} uses, found "
                    f"{absent[0]}; add it to the scene's `cameras`, or name the view's `scenes`"
                )
            if view.times_s is not None or view.frames == "all":
                continue
            outside = [
                frame for frame in view.frames if not self.first_frame <= float(frame) <= self.last_frame
            ]
            if outside:
                raise DataError(
                    f"view {view.name}: frames {outside!s:.200} are not in {self.first_frame}.."
                    f"{self.last_frame} of scene {self.name}; correct them, or name the view's `scenes`"
                )

    def _require_frames(self) -> None:
        first, last, test_frames = self.first_frame, self.last_frame, self.test_frames
        outside = [frame for frame in test_frames if not first <= frame <= last]
        if not 0 <= first <= last <= LAST_FRAME or outside or len(set(test_frames)) != len(test_frames):
            raise DataError(
                f"expected 0 <= first_frame <= last_frame <= {LAST_FRAME} and distinct test_frames between "
                f"them, found {first}..{last} and {list(test_frames)!s:.200}"
            )
        if last - first >= MOST_FRAMES:
            raise DataError(
                f"expected at most {MOST_FRAMES:,} frames a scene, found {first}..{last}; cut the drive into "
                "scenes"
            )
        if len(test_frames) > last - first:
            raise DataError("every frame is a test frame; leave at least one to train on")


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Whether a value is a finite number of possible size; a bool is none."""
    # NaN and infinity compare false, too.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _is_text(value: object) -> bool:
    return isinstance(value, str) and bool(value)


def _is_path(value: object) -> bool:
    return isinstance(value, Path) and "\0" not in str(value) and len(str(value)) <= _LONGEST_PATH


def _is_folder_of_camera(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and _is_text(value[0]) and _is_path(value[1])


def _all(
    is_one: Callable[[object], bool], fewest: int = 1, most: int = MOST_FRAMES
) -> Callable[[object], bool]:
    """A test whether a value is a tuple of `fewest` to `most` items that pass `is_one`."""
    return lambda value: isinstance(value, tuple) and fewest <= len(value) <= most and all(map(is_one, value))


def _or_none(is_one: Callable[[object], bool]) -> Callable[[object], bool]:
    return lambda value: value is None or is_one(value)


_VIEW_KINDS: dict[str, tuple[Callable[[object], bool], str]] = {
    "scenes": (_or_none(_all(_is_text)), "names of scenes, or None for all"),
    "sensor": (_or_none(_is_text), "a sensor's name, or None for the recorded one"),
    "shift_m": (_all(is_number, 3, 3), "three numbers: forward, left, up"),
    "yaw_deg": (is_number, "a number of degrees"),
    "frames": (
        lambda value: value == "all" or _all(_is_whole, 0)(value),
        '"all" or a tuple of frame numbers',
    ),
    "times_s": (_or_none(_all(is_number)), "a tuple of seconds, or None"),
    "frozen_at_s": (_or_none(is_number), "seconds since the scene's first frame, or None"),
    "exports": (_all(_is_text), "a tuple of formats"),
    "truth": (_all(_is_folder_of_camera, 0), "a tuple of cameras, each with a Path"),
}
_SCENE_KINDS: dict[str, tuple[Callable[[object], bool], str]] = {
    "root": (_is_path, f"a Path of at most {_LONGEST_PATH} characters"),
    "first_frame": (_is_whole, "a whole number"),
    "last_frame": (_is_whole, "a whole number"),
    "test_frames": (_all(_is_whole, 0), "a tuple of frame numbers"),
    "sweep_period_s": (_or_none(is_number), "seconds of one sweep, or None"),
    "cameras": (_or_none(_all(_is_text, 0)), "a tuple of cameras, or None for all"),
    "recipe": (_or_none(_is_text), "a recipe's name, or None"),
    "compensate": (lambda value: isinstance(value, bool), "true or false"),
    "views": (_all(lambda view: isinstance(view, ViewEntry), 0), "a tuple of ViewEntry"),
}


def _require_kinds(entry: object, kinds: Mapping[str, tuple[Callable[[object], bool], str]]) -> None:
    """Refuse fields of other kinds: a dataclass does not check its annotations."""
    for name, (is_kind, words) in kinds.items():
        value = getattr(entry, name)
        if not is_kind(value):
            raise DataError(f"{name}: expected {words}, found {value!r:.60}")


def _require_name(what: str, name: str, reserved: tuple[str, ...] = ()) -> None:
    fault = name_fault(name, reserved)
    if fault is not None:
        raise DataError(f"{what}: {fault}")
