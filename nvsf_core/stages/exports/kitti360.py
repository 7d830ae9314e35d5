"""Format `kitti360`: the whole layout of a KITTI-360 drive, which this project ingests again.

Beside `velodyne_points/data`, `ring` and `time` hold the laser and the time after the stamp of each point:
the data set itself does not have them.

Frames are numbered as the data set's files; timestamps have a line a frame from frame 0, those between hold
the times that an even pace would give them. Recorded images are rectified: `image_02` and `image_03`,
whose recorded images are fisheyes, come as MEI cameras without distortion. Cameras of other intrinsics take
the places that these leave free.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.boxes import STATIC_FRAME, Box, class_of, number_in_boxes
from nvsf_core.drives.kitti360.layout import CAMERAS, FISHEYE_CAMERAS, DriveLayout
from nvsf_core.drives.kitti360.scans import write_column, write_scan
from nvsf_core.drives.kitti360.writer import (
    MOST_LINES_BEFORE,
    UNDATED_S,
    write_boxes,
    write_calibration,
    write_frame_poses,
    write_grey,
    write_image,
    write_times,
)
from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stages.exports.camera_places import in_free_places
from nvsf_core.stages.exports.records import BoxRecord, CameraRecord, DataSet

FOLDER = "kitti360"
_LIDAR_TO_POSE = np.diag([1.0, -1.0, -1.0, 1.0])
"""The pose frame (x forward, y right, z down) lies in the LiDAR."""


def kitti360_cameras(cameras: Mapping[str, CameraRecord]) -> dict[str, str]:
    """Camera to its name in the layout; those that find no place are left out.

    One that has a name of the layout keeps it. Of the others MEI cameras take fisheyes' places that are free,
    pinholes what is free then.
    """
    own = {name: name for name in cameras if name in CAMERAS}
    flat = [name for name, camera in cameras.items() if isinstance(camera.model, Pinhole)]
    own |= in_free_places([name for name in cameras if name not in flat], FISHEYE_CAMERAS, own)
    own |= in_free_places(flat, CAMERAS, own)
    return {name: own[name] for name in cameras if name in own}


def write_kitti360(folder: Path, data: DataSet) -> None:
    """Write a data set as a KITTI-360 root of one sequence."""
    layout = DriveLayout(folder / FOLDER, data.sequence)
    names = {there: own for own, there in kitti360_cameras(data.cameras).items()}
    cameras = {name: data.cameras[own] for name, own in names.items()}
    _write_calibration(layout, cameras)
    pose_to_world = data.lidar_to_world @ invert_pose(_LIDAR_TO_POSE)
    write_frame_poses(layout.poses_path, data.numbers, pose_to_world, rows=3)
    if "image_00" in cameras:
        camera_to_world = data.lidar_to_world @ cameras["image_00"].in_lidar
        write_frame_poses(layout.cam0_to_world_path, data.numbers, camera_to_world, rows=4)
    stamps, begin_s = _stamps_from_0(data.numbers, data.stamp_s, data.sweep_period_s)
    # Without a date frame 0 is of its first hour: readers take no year before 1970.
    origin_s = data.origin_s if data.origin_s == UNDATED_S else data.origin_s + begin_s
    write_times(layout, cameras, stamps, data.sweep_period_s, origin_s)
    boxes = [data.boxes(index) for index in range(len(data.numbers))]
    objects = object_numbers({one.object_id: one.label for there in boxes for one in there})
    write_boxes(layout.boxes_path("train"), _written(data, boxes, objects), data.numbers[0], data.numbers[-1])
    for index, number in enumerate(data.numbers):
        if data.scan is not None:
            scan = data.scan(index)
            write_scan(layout.scan_path(number), scan.rows[:, :3], scan.rows[:, 3])
            for name, values in scan.beside.items():
                write_column(layout.column_path(name, number), values)
        for name, own in names.items():
            image = data.image(own, index)
            write_image(layout.image_path(name, number), image.rgb)
            if image.object_id is not None:
                instances = _renumbered(image.object_id, objects)
                write_grey(layout.instance_path(name, number), instances, np.uint16)


def _write_calibration(layout: DriveLayout, cameras: dict[str, CameraRecord]) -> None:
    in_lidar = {name: camera.in_lidar for name, camera in cameras.items()}
    # The LiDAR's mounting is given by that of camera 0, so without images one is assumed in its place.
    if "image_00" not in in_lidar:
        in_lidar = {"image_00": invert_pose(_LIDAR_TO_POSE), **in_lidar}
    to_pose = {name: _LIDAR_TO_POSE @ pose for name, pose in in_lidar.items()}
    models = {name: camera.model for name, camera in cameras.items()}
    write_calibration(layout, models, to_pose, in_lidar["image_00"])


def _stamps_from_0(numbers: Sequence[int], stamp_s: np.ndarray, period_s: float) -> tuple[np.ndarray, float]:
    """Seconds of the frames 0 to the last, and where on the data set's clock they are 0, at 0 or before.

    Frames that the data set lacks lie evenly between its own. They begin with the first of the data set where
    too many would lie before it.
    """
    step_s = period_s if period_s > 0.0 else 0.1
    frames = np.arange(numbers[0] if numbers[0] > MOST_LINES_BEFORE else 0, max(numbers) + 1)
    found = np.interp(frames, numbers, stamp_s)
    found = np.where(frames < numbers[0], stamp_s[0] - step_s * (numbers[0] - frames), found)
    begin_s = min(0.0, float(found[0]))
    return np.asarray(found - begin_s), begin_s


def object_numbers(objects: Mapping[int, str]) -> dict[int, int]:
    """The layout's number of each object, class * 1000 + instance, the same in boxes and in images.

    An object of a drive in this layout keeps its number. `objects` gives each number's label.

    Raises:
        DataError: A class has more than 1000 objects.
    """
    found, taken = dict[int, int](), set[int]()
    # Those that have a number of their class come first.
    for one in sorted(objects, key=lambda one: (one // 1000 != _class_of(objects[one]), one)):
        first = 1000 * _class_of(objects[one])
        free = (number for number in (first + one % 1000, *range(first, first + 1000)) if number not in taken)
        number = next(free, None)
        if number is None:
            raise DataError(
                f"format kitti360: expected at most 1000 objects of the class {objects[one]!r:.60}, found "
                "more; export fewer frames"
            )
        taken.add(number)
        found[one] = number
    return found


def _class_of(label: str) -> int:
    return class_of(label, number_in_boxes(label))


def _written(
    data: DataSet, boxes: Sequence[Sequence[BoxRecord]], numbers: Mapping[int, int]
) -> Iterable[Box]:
    found: dict[tuple[int, int], Box] = {}
    for frame, there in zip(data.numbers, boxes, strict=True):
        for one in there:
            at = frame if one.is_dynamic else STATIC_FRAME
            found[one.object_id, at] = Box(
                frame=at, object_id=numbers[one.object_id], label=one.label, dynamic=one.is_dynamic,
                box_to_world=one.box_to_world,
            )  # fmt: skip
    return found.values()


def _renumbered(object_id: np.ndarray, numbers: Mapping[int, int]) -> np.ndarray:
    """Labels (H, W) uint16 of an image whose pixels have the objects (H, W); 0 = none."""
    known, place = np.unique(object_id, return_inverse=True)
    labels = np.array([numbers.get(int(one), 0) for one in known], np.uint16)
    return labels[place].reshape(object_id.shape)
