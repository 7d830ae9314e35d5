"""A small data set, made by formula, that every format is written from."""

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import pose_of_angles
from nvsf_core.stages.exports.records import BoxRecord, CameraRecord, DataSet, ImageRecord, ScanRecord

COUNT, POINTS, PERIOD_S = 3, 400, 0.1
NUMBERS = [4, 5, 7]
STAMPS = np.array([0.4, 0.5, 0.7])
LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""A level camera that looks ahead, in the LiDAR's place."""
IN_LIDAR = pose_of_angles((0.5, 0.1, -0.2), 5.0, 3.0, 0.0) @ LEVEL
POSES = np.stack(
    [pose_of_angles((1000.0 + 0.9 * k, 3700.0, 115.0), 30.0 + k, 0.5, -0.2) for k in range(COUNT)]
)
PINHOLE = Pinhole(fx=50.0, fy=52.0, cx=31.0, cy=23.0, width=64, height=48)


def rig(**yaw_deg: float) -> dict[str, CameraRecord]:
    """Level cameras that look to the left of the way ahead by so many degrees."""
    return {
        name: CameraRecord(model=PINHOLE, in_lidar=pose_of_angles((0, 0, 0), turn, 0, 0) @ LEVEL)
        for name, turn in yaw_deg.items()
    }


def scan(index: int) -> ScanRecord:
    generator = np.random.default_rng(index)
    azimuth = np.sort(generator.uniform(0.0, 2.0 * np.pi, POINTS))
    range_m = generator.uniform(3.0, 50.0, POINTS)
    rows = np.column_stack([
        range_m * np.cos(azimuth), range_m * np.sin(azimuth), generator.uniform(-1.7, 2.0, POINTS),
        generator.uniform(0.0, 1.0, POINTS),
    ]).astype(np.float32)  # fmt: skip
    return ScanRecord(
        number=NUMBERS[index], rows=rows, ring=(np.arange(POINTS) // 50).astype("<u2"),
        offset_s=np.linspace(-0.05, 0.05, POINTS).astype("<f4"),
        support=(np.arange(POINTS) % 3).astype(np.uint8), stamp_s=float(STAMPS[index]),
        time_s=float(STAMPS[index]), lidar_to_world=POSES[index],
    )  # fmt: skip


OBJECT_IDS = np.zeros((PINHOLE.height, PINHOLE.width), np.int32)
OBJECT_IDS[5:9, 20:30] = 26_007


def depth(index: int) -> np.ndarray:
    """Metres of each pixel; 0 = not known."""
    values = np.random.default_rng(index).uniform(2.0, 300.0, (PINHOLE.height, PINHOLE.width))
    return np.where(values > 280.0, 0.0, values).astype(np.float32)


def image(camera: str, index: int) -> ImageRecord:
    rgb = np.random.default_rng(index).integers(0, 255, (PINHOLE.height, PINHOLE.width, 3)).astype(np.uint8)
    return ImageRecord(rgb=rgb, depth_m=depth(index), object_id=OBJECT_IDS)


def boxes(index: int) -> list[BoxRecord]:
    size = np.diag([4.0, 1.8, 1.5, 1.0])
    ahead = pose_of_angles((10.0 + index, 2.0, -1.0), 10.0, 0.0, 0.0)
    return [
        BoxRecord(object_id=26_007, label="car", is_dynamic=True, box_to_world=POSES[index] @ ahead @ size),
        BoxRecord(object_id=26_009, label="car", is_dynamic=False, box_to_world=POSES[0] @ ahead @ size),
    ]


def data_set() -> DataSet:
    return DataSet(
        name="small", sequence="2013_05_28_drive_0000_sync", numbers=NUMBERS, stamp_s=STAMPS,
        lidar_to_world=POSES, sweep_period_s=PERIOD_S,
        cameras={"image_00": CameraRecord(model=PINHOLE, in_lidar=IN_LIDAR)}, scan=scan, image=image,
        boxes=boxes,
    )  # fmt: skip
