"""Which files of a drive a scene reads, and whether they are all there."""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from os.path import lexists
from pathlib import Path

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.layout import CAMERAS, FISHEYE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.timestamps import recorded_frames


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Files of a scene's section of a drive, as they are on disk now."""

    files: tuple[Path, ...]
    """Everything there that the scene reads: calibration, poses, times, boxes, then scans and images."""
    folders: tuple[Path, ...]
    """Folders of scans and images that exist: they say which sensors the drive has."""
    missing: tuple[str, ...]
    """Files without which nothing can be made, below the root."""
    gaps: tuple[str, ...]
    """Scans and images that lack, of sensors that have a folder, below the root."""
    recorded: tuple[int, int] | None
    """First and last frame that the whole drive has; timestamps are counted from there."""


def section_of(scene: SceneEntry) -> Section:
    """Look for the files of a scene; none is opened.

    Raises:
        OSError: A folder cannot be read.
    """
    layout = DriveLayout(scene.root, scene.sequence)
    used = scene.cameras if scene.cameras is not None else CAMERAS
    places = [layout.scan_path(0).parent, *(layout.camera_dir(name) for name in CAMERAS)]
    folders = tuple(place for place in places if place.is_dir())
    wanted = [path for path in _frame_files(layout, scene, used) if path.parent in folders]
    frames = recorded_frames(layout)
    needed = [layout.poses_path, layout.calibration_dir]
    return Section(
        files=tuple(path for path in (*_common_files(layout), *wanted) if lexists(path)),
        folders=folders,
        missing=tuple(_below(path, layout) for path in needed if not lexists(path)),
        gaps=tuple(_below(path, layout) for path in wanted if not lexists(path)),
        recorded=(frames[0], frames[-1]) if frames else None,
    )


GAPS_WAIT = 30
"""How many times longer a drive that lacks scans or images has to lie unchanged before it counts as whole."""


def why_wait(section: Section, quiet_s: float) -> str:
    """Why a drive is not whole yet, as one that is still being copied is not; empty if it is.

    The change times of files say when they came here, whatever modification times a copy gave them. They
    cannot be set by anybody, and a drive that is moved within a disk keeps its own.

    Args:
        section: Files of the scene's section.
        quiet_s: How long nothing may have changed.
    """
    if not section.folders or not section.files:
        return "no scan or image yet"
    if section.missing:
        return f"{', '.join(section.missing)} not there yet"
    # A clock that was set back shows times to come: they too only count while they are near.
    age_s = abs(time.time() - _newest_s(section))
    if age_s < quiet_s:
        return f"something changed {age_s:.0f} s ago; {quiet_s:.0f} s without a change are awaited"
    if section.gaps and age_s < GAPS_WAIT * quiet_s:
        return (
            f"{len(section.gaps)} scans or images lack, as {section.gaps[0]}; {GAPS_WAIT * quiet_s:.0f} s "
            "without a change are awaited"
        )
    return ""


def _newest_s(section: Section) -> float:
    """When the last of the section's files and folders changed, seconds since the epoch."""
    newest_s = 0.0
    for path in (*section.files, *section.folders):
        with contextlib.suppress(FileNotFoundError):
            newest_s = max(newest_s, path.stat().st_ctime)
    return newest_s


def _common_files(layout: DriveLayout) -> Iterator[Path]:
    """Files that are read whatever frames a scene has."""
    yield from (layout.perspective_path, layout.cam_to_pose_path, layout.cam_to_velo_path)
    yield from (layout.fisheye_path(camera) for camera in FISHEYE_CAMERAS)
    yield from (layout.poses_path, layout.cam0_to_world_path)
    yield from (layout.timestamps_path(kind) for kind in ("", "start", "end"))
    yield from (layout.camera_timestamps_path(camera) for camera in CAMERAS)
    yield from layout.boxes_paths


def _frame_files(layout: DriveLayout, scene: SceneEntry, cameras: tuple[str, ...]) -> Iterator[Path]:
    for frame in range(scene.first_frame, scene.last_frame + 1):
        yield layout.scan_path(frame)
        yield from (layout.image_path(camera, frame) for camera in cameras)


def _below(path: Path, layout: DriveLayout) -> str:
    return path.relative_to(layout.root).as_posix()
