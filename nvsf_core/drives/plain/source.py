"""A drive as a folder of plain files (docs/drives.md): for every recording that has no reader of its own."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from os.path import lexists
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import Boxes, DriveFacts, Recorded
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.calibration import Calibration
from nvsf_core.drives.kitti360.frames import NOMINAL_PERIOD_S, FrameTimes
from nvsf_core.drives.kitti360.images import decode_picture, read_image_bytes
from nvsf_core.drives.kitti360.scans import (
    COLUMNS,
    MAX_ABSURD_SHARE,
    Scan,
    parse_columns,
    read_columns,
    usable_scan,
)
from nvsf_core.drives.kitti360.text import read_bytes
from nvsf_core.drives.lenses import Lens
from nvsf_core.drives.plain.box_table import read_box_table
from nvsf_core.drives.plain.clouds import MOST_FILE_BYTES, Columns, read_bin, read_pcd, read_ply
from nvsf_core.drives.plain.description import Description, read_cameras, read_description, read_json
from nvsf_core.drives.plain.layout import IMAGE_KINDS, SCAN_KINDS, PlainLayout, numbered_files
from nvsf_core.drives.plain.tables import read_pose_table, read_times
from nvsf_core.drives.point_times import after_frame
from nvsf_core.drives.posed import AbstractPosedDrive, PosePath
from nvsf_core.drives.section import Section
from nvsf_core.drives.unread import (
    require_files_of_scans,
    require_one_of_each,
    unknown_names,
    unnamed_files,
)
from nvsf_core.errors import DataError

_TIME_NAMES = ("time", "t", "timestamp", "time_offset")
_SAME_TIME_S = 1e-3
"""Times of a frame in two tables differ by their digits; 1 ms is 3 cm at 30 m/s."""


class PlainDrive(AbstractPosedDrive):
    """Reads `scans/`, `poses.csv`, `cameras.json`, `images/` and what may lie beside them."""

    def __init__(self, scene: SceneEntry) -> None:
        super().__init__(scene)
        self.layout = PlainLayout(scene.root)

    @cached_property
    def _scans(self) -> dict[int, Path]:
        return numbered_files(self.layout.scans_dir, SCAN_KINDS)

    @cached_property
    def _beside(self) -> dict[str, dict[int, Path]]:
        """Files beside the scans, by what they hold and frame."""
        return {name: numbered_files(self.layout.beside_dir(name), ("bin",)) for name in COLUMNS}

    @cached_property
    def _images(self) -> dict[str, dict[int, Path]]:
        folder = self.layout.root / "images"
        names = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
        return {name: numbered_files(self.layout.images_dir(name), IMAGE_KINDS) for name in names}

    @cached_property
    def _recorded(self) -> set[int]:
        """Frames of the whole drive that have a scan or an image."""
        return {*self._scans, *(frame for files in self._images.values() for frame in files)}

    @cached_property
    def _description(self) -> Description:
        return read_description(self.layout.drive_path)

    def has_data(self) -> bool:
        """Whether a scan or an image of the section is there."""
        found = [self._scans, *self._images.values()]
        return any(frame in files for files in found for frame in self.frames)

    def section(self) -> Section:
        """The tables, and the section's scans and images."""
        layout = self.layout
        tables = [layout.drive_path, layout.poses_path, layout.frames_path, layout.cameras_path]
        tables += [layout.boxes_path, *(layout.image_times_path(name) for name in self._images)]
        scans = [self._scans[frame] for frame in self.frames if frame in self._scans]
        beside = [files[frame] for files in self._beside.values() for frame in self.frames if frame in files]
        used = self._images if self.scene.cameras is None else self.scene.cameras
        images = [
            files[frame] for name, files in self._images.items() if name in used
            for frame in self.frames if frame in files
        ]  # fmt: skip
        folders = [layout.scans_dir, *(layout.images_dir(name) for name in self._images)]
        gaps = [f"scans/{frame:010d}" for frame in self.frames if self._scans and frame not in self._scans]
        return Section(
            files=tuple(path for path in (*tables, *scans, *beside, *images) if lexists(path)),
            folders=tuple(folder for folder in folders if folder.is_dir()),
            missing=() if lexists(layout.poses_path) else (layout.poses_path.name,),
            gaps=tuple(gaps),
            recorded=(min(self._recorded), max(self._recorded)) if self._recorded else None,
        )

    def unread(self) -> list[str]:
        """Misnamed files and folders."""
        layout, wanted = self.layout, self.scene.cameras
        cameras = [name for name in self._images if wanted is None or name in wanted]
        places = [(layout.scans_dir, SCAN_KINDS), *((layout.beside_dir(name), ("bin",)) for name in COLUMNS)]
        places += [(layout.images_dir(name), IMAGE_KINDS) for name in cameras]
        words = [one for folder, kinds in places for one in unnamed_files(folder, kinds)]
        for folder, kinds in places:
            require_one_of_each(folder, kinds, self.frames)
        may_lack = wanted is None and not any(self._images.values())
        lacks_images = may_lack and lexists(layout.cameras_path) and bool(read_json(layout.cameras_path))
        return words + unknown_names(layout, has_scans=self.has_scans(), lacks_images=lacks_images)

    def facts(self) -> DriveFacts:
        """Calibration, poses and times.

        Raises:
            DataError: There are rings or times, and none of any scan; and see the base class.
        """
        for name in self._beside:
            require_files_of_scans(self.layout.beside_dir(name), self._scans)
        return super().facts()

    @cached_property
    def _poses(self) -> tuple[PosePath, np.ndarray | None]:
        return read_pose_table(self.layout.poses_path)

    def pose_path(self) -> PosePath | None:
        """Poses of `poses.csv`."""
        return self._poses[0] if lexists(self.layout.poses_path) else None

    def frame_seconds(self) -> dict[int, float]:
        """Times of `frames.csv`, or of the poses by their frame; without both, a nominal pace."""
        layout = self.layout
        if lexists(layout.frames_path):
            seconds = read_times(layout.frames_path)
            path, frames = self._poses if lexists(layout.poses_path) else (None, None)
            if path is not None and frames is not None:
                _require_same_times(seconds, path, frames)
            return seconds
        if not lexists(layout.poses_path):
            period_s = self.scene.sweep_period_s or NOMINAL_PERIOD_S
            return {frame: frame * period_s for frame in self._scans}
        path, frames = self._poses
        if frames is None:
            raise DataError(
                f"{layout.poses_path}: expected a column `frame`, or a file frames.csv with the columns "
                "frame and time_s, found neither: which scan was taken when is not known"
            )
        return dict(zip(frames.tolist(), path.time_s.tolist(), strict=True))

    def times(self) -> FrameTimes:
        """As their table says; assumed where there is none, and where an import had none to write."""
        times, layout = super().times(), self.layout
        assumed = self._description.times_assumed
        if not assumed and not lexists(layout.frames_path) and not lexists(layout.poses_path):
            assumed = f"assumed {times.sweep_period_s:g} s a frame: neither frames.csv nor poses.csv"
        return replace(times, is_assumed=True, source=assumed) if assumed else times

    def clock_zero_s(self) -> float | None:
        """`clock_origin_s` of `drive.json`, else see the base class."""
        given_s = self._description.clock_origin_s
        return super().clock_zero_s() if given_s is None else given_s

    @property
    def boxes_after_s(self) -> float:
        """As `drive.json` says, from the frames' times as recorded."""
        return super().boxes_after_s + self._description.boxes_after_s

    @property
    def times_source(self) -> str:
        """`frames.csv` or `poses.csv`."""
        layout = self.layout
        return (layout.frames_path if lexists(layout.frames_path) else layout.poses_path).name

    def has_scans(self) -> bool:
        """Whether there is a scan at all."""
        return bool(self._scans)

    def recorded_sensor(self) -> str:
        """`lidar` of `drive.json`."""
        return self._description.lidar

    @cached_property
    def _mounted(self) -> tuple[Calibration, dict[str, Lens]]:
        present = [name for name, files in self._images.items() if files]
        return read_cameras(
            self.layout.cameras_path, self.scene.cameras, present, self._description.lidar_to_pose
        )

    def calibration(self) -> Calibration:
        """`cameras.json`, of the cameras that have a folder of images."""
        return self._mounted[0]

    @cached_property
    def _image_seconds(self) -> dict[str, dict[int, float]]:
        paths = {name: self.layout.image_times_path(name) for name in self._images}
        return {name: read_times(path) for name, path in paths.items() if lexists(path)}

    def image_seconds(self, camera: str) -> dict[int, float]:
        """`images/<camera>/times.csv`."""
        return self._image_seconds.get(camera, {})

    def camera_place(self, camera: str) -> Path | None:
        """Its folder of images."""
        return self.layout.images_dir(camera) if camera in self._images else None

    def scan_name(self, frame: int) -> str:
        """For messages."""
        return f"scans/{frame:010d}.bin, .ply or .pcd"

    def image_name(self, camera: str, frame: int) -> str:
        """For messages."""
        return f"images/{camera}/{frame:010d}.png or .jpg"

    def find_scan(self, frame: int) -> Recorded | None:
        """The bytes of the scan, and of ring and time beside it."""
        path = self._scans.get(frame)
        if path is None:
            return None
        data = read_bytes(path, MOST_FILE_BYTES, "scan")
        beside = {name: files[frame] for name, files in self._beside.items() if frame in files}
        return Recorded(path, data, read_columns(beside))

    def _decoded(self, found: Recorded) -> Scan:
        read = {".bin": read_bin, ".ply": read_ply, ".pcd": read_pcd}[found.path.suffix.lower()]
        columns = dict(read(found.path, found.data))
        columns |= parse_columns(found.path, found.beside, len(columns.get("x", ())))
        if {"x", "y", "z"} <= columns.keys():
            # A cloud with a place for each ray has NaN where nothing returned.
            is_return = np.isfinite([columns[name] for name in "xyz"]).all(axis=0)
            columns = {name: values[is_return] for name, values in columns.items()}
        _require_intensities(found.path, columns, self._description.intensity_max)
        stamp_s = self._seconds.get(int(found.path.stem))
        return scan_of_columns(found.path, columns, self._description.intensity_max, stamp_s)

    def find_image(self, camera: str, frame: int, width: int, height: int) -> Recorded | None:
        """The bytes of a PNG or JPEG; refused where the camera's images have times, and this one has none."""
        path = self._images.get(camera, {}).get(frame)
        if path is None:
            return None
        seconds = self.image_seconds(camera)
        if seconds and frame not in seconds:
            place = self.layout.image_times_path(camera)
            raise DataError(
                f"{place}: expected the time of {path.name}, found none of frame {frame}; add its row, or "
                "remove the file where all images are of their frame's time"
            )
        return Recorded(path, read_image_bytes(path, width, height))

    def parse_image(self, camera: str, found: Recorded, width: int, height: int) -> np.ndarray:
        """Decode an image and take out the distortion that the flow has no model of."""
        return self.rectified(camera, decode_picture(found.path, found.data, width, height))

    def rectified(self, camera: str, rgb: np.ndarray) -> np.ndarray:
        """The image without the distortion that the flow has no model of."""
        return self._mounted[1][camera].rectified(rgb)

    def boxes(self) -> Boxes:
        """`boxes.csv`."""
        if not lexists(self.layout.boxes_path):
            return Boxes()
        named = {*self._seconds, *self._recorded}
        whole = range(min(named, default=0), max(named, default=-1) + 1)
        boxes, left_out = read_box_table(self.layout.boxes_path, self.frames, whole)
        return Boxes(tuple(boxes), tuple(left_out))


def scan_of_columns(path: Path, columns: Columns, intensity_max: float, stamp_s: float | None = None) -> Scan:
    """A scan from columns by name.

    Args:
        path: The file, for messages.
        columns: (N,) each: x, y, z; intensity, ring and time where present.
        intensity_max: Intensity of the brightest returns, which becomes 1.
        stamp_s: Time of the frame, if it can be on the clock that points may be stamped by.

    Raises:
        DataError: A coordinate is absent, times are no scan's, or see `usable_scan`.
    """
    absent = [name for name in ("x", "y", "z") if name not in columns]
    if absent:
        raise DataError(f"{path}: expected x, y, z of each point, found {', '.join(columns)!s:.100}")
    intensity = _intensity(columns)
    zero = np.zeros(len(columns["x"]))
    shine = zero if intensity is None else intensity.astype(np.float64) / intensity_max
    rows = np.stack([columns[name].astype(np.float32) for name in ("x", "y", "z")], axis=1)
    points = np.column_stack([rows, np.minimum(shine, 1.0) if intensity_max > 1.0 else shine])
    name = next((one for one in _TIME_NAMES if one in columns), None)
    time = None
    if name is not None:
        # Some drivers write dropped rays as points at the sensor's origin, with a time of 0.
        time = after_frame(f"{path}: {name}", columns[name], np.asarray(rows.any(axis=1)), stamp_s)
    return usable_scan(path, points.astype(np.float32), columns.get("ring"), time)


def _intensity(columns: Columns) -> np.ndarray | None:
    return columns.get("intensity", columns.get("reflectivity"))


def _require_same_times(seconds: Mapping[int, float], path: PosePath, frames: np.ndarray) -> None:
    """Refuse poses whose frames (n,) were at other times than `frames.csv` says: either may be wrong.

    Raises:
        DataError: One is farther off than a millisecond.
    """
    for frame, time_s in zip(frames.tolist(), path.time_s.tolist(), strict=True):
        if abs(seconds.get(frame, time_s) - time_s) > _SAME_TIME_S:
            raise DataError(
                f"{path.place}: expected frame {frame} at {seconds[frame]:.6f} s, as frames.csv says, found "
                f"{time_s:.6f} s; correct one of both, or delete the column `frame` if poses are not of the "
                "scans' times, or frames.csv if they are"
            )


def _require_intensities(path: Path, columns: Columns, intensity_max: float) -> None:
    """Refuse intensities of another scale than the drive's.

    Raises:
        DataError: More than some of them are above 1, and none may be.
    """
    intensity = _intensity(columns)
    if intensity is None or len(intensity) == 0 or intensity_max > 1.0:
        return
    if float((intensity > intensity_max).mean()) > MAX_ABSURD_SHARE:
        brightest = float(intensity.max())
        raise DataError(
            f"{path}: expected intensities 0 to {intensity_max:g}, found up to {brightest:g}; set "
            "intensity_max in drive.json to that of the brightest returns, as 255"
        )
