"""Annotated boxes of moving objects, for metrics by region: per recorded frame, in a sensor's frame."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows

NO_BOXES = "not measured: this drive has no box of a moving object"


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingBoxes:
    """Annotated boxes of a drive's moving objects; used for metrics only, never for training."""

    to_world: dict[int, np.ndarray]
    """Frame to (B, 4, 4) float64 transforms from the unit cube to the world, metres."""
    lidar_to_world: dict[int, np.ndarray]
    """Frame to the (4, 4) pose of the LiDAR."""
    objects: int
    """Number of different objects."""

    def in_lidar(self, frame: int) -> np.ndarray:
        """(B, 4, 4) unit cube to the LiDAR's frame of a recorded frame; B = 0 if nothing moves."""
        return invert_pose(self.lidar_to_world[frame]) @ self._of(frame)

    def in_camera(self, frame: int, camera_to_world: np.ndarray) -> np.ndarray:
        """(B, 4, 4) unit cube to the frame of a camera at the (4, 4) pose `camera_to_world`."""
        return invert_pose(camera_to_world) @ self._of(frame)

    def _of(self, frame: int) -> np.ndarray:
        return self.to_world.get(frame, np.zeros((0, 4, 4)))


def read_moving_boxes(store: SceneStore) -> MovingBoxes | None:
    """The moving objects' boxes, from the stage `frames`; None if the drive has none."""
    frames = store.require("frames")
    rows = [row for row in read_rows(frames / "boxes.parquet") if row["dynamic"]]
    if not rows:
        return None
    by_frame: dict[int, list[np.ndarray]] = {}
    for row in rows:
        by_frame.setdefault(row["frame"], []).append(np.array(row["box_to_world"]).reshape(4, 4))
    posed = [row for row in read_rows(frames / "frames.parquet") if row["pose_valid"]]
    return MovingBoxes(
        to_world={frame: np.stack(boxes) for frame, boxes in by_frame.items()},
        lidar_to_world={row["frame"]: np.array(row["lidar_to_world"]).reshape(4, 4) for row in posed},
        objects=len({row["object_id"] for row in rows}),
    )
