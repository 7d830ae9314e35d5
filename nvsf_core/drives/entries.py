"""Entries of the catalogue; impossible values are refused when an entry is made."""

from dataclasses import dataclass
from pathlib import Path

from nvsf_core.drives.kinds import (
    LONGEST_PATH,
    MOST_FRAMES,
    Kinds,
    each,
    is_bool,
    is_line,
    is_number,
    is_path,
    is_text,
    is_whole,
    or_none,
    require_kinds,
    require_name,
)
from nvsf_core.drives.kitti360.frames import LONGEST_STEP_S, SHORTEST_STEP_S
from nvsf_core.drives.kitti360.layout import CAMERAS, LAST_FRAME
from nvsf_core.drives.view_entry import EXPORTS, ViewEntry
from nvsf_core.drives.view_parts import CAMERA_NAME
from nvsf_core.errors import DataError, RecipeError
from nvsf_core.names import RESERVED_SCENES
from nvsf_core.recipe.presets import preset
from nvsf_core.sensors.tables import SENSOR_TABLES

__all__ = ["DRIVE_KINDS", "EXPORTS", "FOUND", "KITTI360", "MOST_FRAMES", "SceneEntry", "ViewEntry"]

KITTI360, KITTI_ODOMETRY = "kitti360", "kitti_odometry"
_KITTI_KINDS = (KITTI360, KITTI_ODOMETRY, "kitti_raw")
"""Formats whose cameras are `image_00` to `image_03`."""
BAG = "bag"
OWN_ROOT_KINDS = ("plain", BAG)
"""Formats whose root is one drive."""
DRIVE_KINDS = (*_KITTI_KINDS, *OWN_ROOT_KINDS)
"""Formats of recorded drives."""
FOUND = "found"
"""`lidar` of a scene whose lasers are found from its scans."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneEntry:
    """A section of a drive: `[[scene]]` of a catalogue."""

    name: str
    """Name of the scene; Dagster's partition key."""
    root: Path
    """KITTI-360 root that holds `data_3d_raw`, `data_2d_raw`, `data_poses`, `calibration`; of another `kind`
    the folder of the drive, KITTI's root, or the bag."""
    sequence: str
    """Name of the drive, for example `2013_05_28_drive_0000_sync`; of KITTI's odometry `00` to `21`. Of the
    kinds `plain` and `bag` it only names exported data: the scene's name if it is left out."""
    first_frame: int
    """First frame number, inclusive."""
    last_frame: int
    """Last frame number, inclusive."""
    test_frames: tuple[int, ...]
    """Test frames: never trained on, never used to choose anything."""
    sweep_period_s: float | None = None
    """Duration of a LiDAR sweep. None given = by the points' times, else of the kind `kitti360` by the scans'
    `timestamps_start.txt` and `timestamps_end.txt`, or the step from frame to frame, which also stands for
    one that is given or found and is within a tenth of it. Frames without timestamps are spaced by it, and it
    is stored as assumed."""
    cameras: tuple[str, ...] | None = None
    """Cameras to use; None = every camera present and calibrated."""
    recipe: str | None = None
    """Recipe if a run names none."""
    compensate: bool | None = None
    """Ego-motion compensation: each return is placed by the sensor's pose at its own time. False = one pose
    for a whole sweep, as papers do. None given = false of the kind `kitti_odometry`, whose scans are
    compensated already, else true."""
    kind: str = KITTI360
    """Format of the drive: `kitti360`; `plain`, a folder of plain files; `kitti_odometry`; `kitti_raw`;
    `bag`, of ROS 1 or 2, or MCAP (docs/drives.md)."""
    lidar: str | None = None
    """The LiDAR that recorded the drive, a known one by its name, or `found`: its lasers are found from the
    scans. None given = as the drive says."""
    lidar_topic: str | None = None
    """Of a bag with several topics of point clouds, the one to read, as `/velodyne_points`. None = of those
    whose points have a laser or a time, else of all, the one with the most messages."""
    rectified: tuple[str, ...] = ()
    """Of a bag, cameras whose images are rectified already though their topic's name does not say so: their
    camera info's `P` holds, without distortion."""
    licence: str | None = None
    """Licence of the recording in a few words, for the cards of its data sets; None = not stated."""
    cut_frames: int | None = None
    """Most frames of a part of a long drive: the entry stands for scenes `name_000`, `name_001`, ..., each
    trained by itself; `nvsf join` makes one data set of theirs. Its views name frames or `rate_hz` on the
    recorded path, not `times_s`, `frozen_at_s` or a path of their own. None = one scene."""
    overlap_frames: int = 8
    """Frames that neighbouring parts share at least; less than half of `cut_frames`."""
    views: tuple[ViewEntry, ...] = ()
    """The views that apply to this scene."""

    def __post_init__(self) -> None:
        """Refuse values that would otherwise fail only later, or write outside the scene's folder."""
        require_name("name", self.name, RESERVED_SCENES)
        require_name("sequence", self.sequence)
        require_kinds(self, _SCENE_KINDS)
        if self.kind not in DRIVE_KINDS:
            raise DataError(f"kind: expected one of {', '.join(DRIVE_KINDS)}, found {self.kind!r:.60}")
        if self.lidar is not None and self.lidar != FOUND and self.lidar not in SENSOR_TABLES:
            raise DataError(
                f"lidar: expected one of {', '.join(SENSOR_TABLES)}, or {FOUND!r}, found {self.lidar!r:.60}"
            )
        self._require_bag()
        self._require_frames()
        if self.cut_frames is not None and not 0 <= self.overlap_frames < self.cut_frames / 2:
            raise DataError(
                f"overlap_frames: expected 0 to less than half of cut_frames = {self.cut_frames}, found "
                f"{self.overlap_frames}"
            )
        if self.sweep_period_s is not None and not SHORTEST_STEP_S <= self.sweep_period_s <= LONGEST_STEP_S:
            raise DataError(
                f"sweep_period_s: expected {SHORTEST_STEP_S:g} to {LONGEST_STEP_S:g} seconds of one sweep, "
                f"found {self.sweep_period_s}"
            )
        unknown = [name for name in self.cameras or () if not self._may_have(name)]
        if unknown or len(set(self.cameras or ())) != len(self.cameras or ()):
            raise DataError(
                f"cameras: expected different ones of {self._camera_words()}, found {self.cameras!r:.200}"
            )
        if self.recipe is not None:
            try:
                preset(self.recipe)
            except RecipeError as error:
                raise DataError(f"recipe: {error}") from error

        self._require_views()

    def _require_bag(self) -> None:
        for key in ("lidar_topic", "rectified"):
            if getattr(self, key) and self.kind != BAG:
                raise DataError(
                    f"{key}: expected a scene of the kind {BAG!r}, found {self.kind!r}; leave it out"
                )

    @property
    def is_to_compensate(self) -> bool:
        """Whether each return is to be placed by the sensor's pose at its own time."""
        return self.kind != KITTI_ODOMETRY if self.compensate is None else self.compensate

    @property
    def is_lidar_assumed(self) -> bool:
        """Whether the LiDAR is taken to be KITTI's, as neither entry nor format say otherwise."""
        return self.lidar is None and self.kind in _KITTI_KINDS

    def _may_have(self, camera: str) -> bool:
        """Whether the format can have a camera of that name."""
        return camera in CAMERAS if self.kind in _KITTI_KINDS else bool(CAMERA_NAME.fullmatch(camera))

    def _camera_words(self) -> str:
        return ", ".join(CAMERAS) if self.kind in _KITTI_KINDS else "the drive's own, as `front`"

    def _require_views(self) -> None:
        names = [view.name.casefold() for view in self.views]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise DataError(
                f"scene {self.name}: views: expected each name once, upper or lower case, found {twice[0]!r} "
                "again; rename one"
            )
        for view in self.views:
            asked = {"truth": [name for name, _ in view.truth], "cameras": list(view.cameras or ()),
                     "like": [camera.like for camera in view.camera]}  # fmt: skip
            for key, names in asked.items():
                absent = [
                    name
                    for name in names
                    if not self._may_have(name) or (self.cameras is not None and name not in self.cameras)
                ]
                if absent:
                    raise DataError(
                        f"view {view.name}: {key}: expected cameras that scene {self.name} uses, found "
                        f"{absent[0]}; add it to the scene's `cameras`, or name the view's `scenes`"
                    )
            if view.frames == "all":
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


_SCENE_KINDS: Kinds = {
    "root": (is_path, f"a Path of at most {LONGEST_PATH} characters"),
    "first_frame": (is_whole, "a whole number"),
    "last_frame": (is_whole, "a whole number"),
    "test_frames": (each(is_whole, 0), "a tuple of frame numbers"),
    "sweep_period_s": (or_none(is_number), "seconds of one sweep, or None"),
    "cameras": (or_none(each(is_text, 0)), "a tuple of cameras, or None for all"),
    "recipe": (or_none(is_text), "a recipe's name, or None"),
    "compensate": (or_none(is_bool), "true or false"),
    "kind": (is_text, f"one of {', '.join(DRIVE_KINDS)}"),
    "lidar": (or_none(is_text), "a LiDAR's name, or None"),
    "rectified": (each(is_text, 0), "a tuple of cameras"),
    "lidar_topic": (or_none(is_line), "a topic of the bag, or None"),
    "cut_frames": (or_none(is_whole), "a whole number, or None"),
    "overlap_frames": (is_whole, "a whole number"),
    "licence": (or_none(is_line), "a line of at most 200 characters, or None"),
    "views": (each(lambda view: isinstance(view, ViewEntry), 0), "a tuple of ViewEntry"),
}
