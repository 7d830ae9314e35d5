"""Which files of a KITTI-360 drive a scene reads."""

from collections.abc import Iterator
from os.path import lexists
from pathlib import Path

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.layout import CAMERAS, FISHEYE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.timestamps import recorded_frames
from nvsf_core.drives.section import Section


def kitti360_section(scene: SceneEntry) -> Section:
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
