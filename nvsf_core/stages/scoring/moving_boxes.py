"""Annotated boxes of moving objects, for metrics by region: in a sensor's frame, of a frame or an image."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.boxes import box_between
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

NO_BOXES = "not measured: this drive has no box of a moving object"


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingBoxes:
    """Annotated boxes of a drive's moving objects; used for metrics only, never for training."""

    to_world: dict[int, dict[int, np.ndarray]]
    """Frame to object to the (4, 4) float64 transform from the unit cube to the world, metres."""
    boxes_time_s: dict[int, float]
    """Frame to the moment that its boxes are of, seconds since the first frame."""
    time_s: dict[int, float]
    """Frame to the instant of its scan, on the same clock."""
    lidar_to_world: dict[int, np.ndarray]
    """Frame to the (4, 4) pose of the LiDAR."""
    objects: int
    """Number of different objects."""

    def in_lidar(self, frame: int) -> np.ndarray:
        """(B, 4, 4) unit cube to the LiDAR's frame at a recorded frame's instant; B = 0 if nothing moves."""
        there = [self._at(one, self.time_s[frame]) for one in self.to_world.get(frame, {})]
        return invert_pose(self.lidar_to_world[frame]) @ np.array(there).reshape(-1, 4, 4)

    def in_camera(self, frame: int, time_s: float, camera_to_world: np.ndarray) -> np.ndarray:
        """(B, 4, 4) unit cube to a camera's frame, of the objects that have a box in a recorded frame.

        The image was taken at `time_s`, which need not be the frame's instant.
        """
        there = [self._at(one, time_s) for one in self.to_world.get(frame, {})]
        return invert_pose(camera_to_world) @ np.array(there).reshape(-1, 4, 4)

    def _at(self, number: int, time_s: float) -> np.ndarray:
        """(4, 4) box of an object between its annotated ones; before and after them its motion goes on."""
        frames = sorted(frame for frame, boxes in self.to_world.items() if number in boxes)
        boxes = [self.to_world[frame][number] for frame in frames]
        if len(boxes) == 1:
            return boxes[0]
        known_s = np.array([self.boxes_time_s[frame] for frame in frames])
        before = int(np.clip(np.searchsorted(known_s, time_s) - 1, 0, len(boxes) - 2))
        share = (time_s - known_s[before]) / (known_s[before + 1] - known_s[before])
        return box_between(boxes[before], boxes[before + 1], share)


def read_moving_boxes(store: SceneStore) -> MovingBoxes | None:
    """The moving objects' boxes, from the stage `frames`; None if the drive has none."""
    frames = store.require("frames")
    rows = [row for row in read_rows(frames / "boxes.parquet") if row["dynamic"]]
    if not rows:
        return None
    to_world: dict[int, dict[int, np.ndarray]] = {}
    for row in rows:
        box = np.array(row["box_to_world"]).reshape(4, 4)
        to_world.setdefault(row["frame"], {})[row["object_id"]] = box
    recorded = read_rows(frames / "frames.parquet")
    posed = [row for row in recorded if row["pose_valid"]]
    return MovingBoxes(
        to_world=to_world,
        boxes_time_s={row["frame"]: row.get("boxes_time_s", row["time_s"]) for row in recorded},
        time_s={row["frame"]: row["time_s"] for row in recorded},
        lidar_to_world={row["frame"]: np.array(row["lidar_to_world"]).reshape(4, 4) for row in posed},
        objects=len({row["object_id"] for row in rows}),
    )
