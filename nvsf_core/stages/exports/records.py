"""What a data set holds, for any format: scans, images, cameras and boxes, read a frame at a time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from nvsf_core.drives.kitti360.writer import UNDATED_S
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScanRecord:
    """One scan: N returns in a driver's order, in the sensor's frame at each one's own time."""

    number: int
    """Of its files."""
    rows: np.ndarray
    """(N, 4) float32: x, y, z in metres, intensity 0..1."""
    ring: np.ndarray
    """(N,) uint16: laser, 0 = top."""
    offset_s: np.ndarray
    """(N,) float32: time after the scan's stamp, on the sensor's clock."""
    support: np.ndarray
    """(N,) uint8 `Support`."""
    stamp_s: float
    """On the sensor's clock."""
    time_s: float
    """Instant of the scene."""
    lidar_to_world: np.ndarray
    """(4, 4) at the stamp, metres."""

    @property
    def beside(self) -> dict[str, np.ndarray]:
        """What lies in files beside the scan's."""
        return {"ring": self.ring, "time": self.offset_s, "support": self.support}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ImageRecord:
    """One image of a camera."""

    rgb: np.ndarray
    """(H, W, 3) uint8."""
    depth_m: np.ndarray
    """(H, W) float32 along the optical axis, of a fisheye along the ray, metres; 0 = not known."""
    object_id: np.ndarray | None = None
    """(H, W) int32: object, labelled or found to move, that each pixel shows; 0 = none."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CameraRecord:
    """A camera of a data set."""

    model: Pinhole | MeiFisheye
    in_lidar: np.ndarray
    """(4, 4) camera to LiDAR."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BoxRecord:
    """An object, labelled or found to move, at one instant."""

    object_id: int
    label: str
    is_dynamic: bool
    box_to_world: np.ndarray
    """(4, 4) unit cube to world; the 3 x 3 part has the size as scale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSet:
    """A data set; its scans and images are made when they are asked for."""

    name: str
    """Of the view."""
    sequence: str
    """Of the recorded drive."""
    numbers: list[int]
    """Of its n instants, for file names, ascending."""
    stamp_s: np.ndarray
    """(n,) on the sensor's clock."""
    lidar_to_world: np.ndarray
    """(n, 4, 4)."""
    origin_s: float = UNDATED_S
    """Seconds from 1970-01-01 to 0 s of the sensor's clock."""
    sweep_period_s: float
    cameras: Mapping[str, CameraRecord]
    scan: Callable[[int], ScanRecord] | None
    """The scan of an instant 0..n-1; None without a LiDAR."""
    image: Callable[[str, int], ImageRecord]
    """The image of a camera at an instant."""
    boxes: Callable[[int], list[BoxRecord]]
    """The objects at an instant."""
