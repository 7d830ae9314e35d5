"""Metrics of held-out images against recorded ones, and of camera depth against LiDAR."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.errors import StoreError
from nvsf_core.geometry.boxes import box_rectangles
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose, transform_points
from nvsf_core.metrics.depth import NO_DEPTH, lidar_depth_images, published_depth_rmse, ray_depth_rmse
from nvsf_core.metrics.foreground import image_regions, masked_image_regions
from nvsf_core.metrics.image import image_metrics
from nvsf_core.metrics.lpips import Lpips
from nvsf_core.metrics.measure import Measure, absent
from nvsf_core.stages.inputs import pinhole_of
from nvsf_core.stages.scoring.lidar import RecordedScans
from nvsf_core.stages.scoring.moving_boxes import MovingBoxes
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_NO_LIDAR = absent("this drive has no LiDAR to compare camera depth with")
DEPTH_METRIC = "image_depth_rmse_m"


@dataclass(frozen=True, slots=True)
class _Recorded:
    """Recorded images of one camera."""

    path: Path
    name: str
    rgb: np.ndarray
    """(m, H, W, 3) uint8."""
    valid: np.ndarray
    """(H, W) bool: pixels that the lens sees."""
    row: dict[int, int]
    """Frame to its row in `rgb`."""

    def camera(self) -> Pinhole:
        """The rectified camera."""
        return pinhole_of(read_attrs(self.path)["cameras"][self.name])

    def poses(self) -> np.ndarray:
        """(m, 4, 4) camera to world, metres."""
        return read_arrays(self.path, f"{self.name}_camera_to_world")[f"{self.name}_camera_to_world"]


def measure_camera(
    path: Path,
    images: Path,
    camera: str,
    boxes: MovingBoxes | None,
    scans: RecordedScans | None,
    ledger: Ledger,
    lpips: Lpips | None,
) -> Iterator[str]:
    """Add the rows of one camera; yields progress after each frame.

    Args:
        path: Zarr group of one method's held-out view.
        images: Zarr group of the undistorted recorded images.
        camera: Name of the camera.
        boxes: Boxes of moving objects; None = no rows of regions.
        scans: Recorded scans, for depth; None for a drive without a LiDAR.
        ledger: Receives the rows.
        lpips: The LPIPS network; None if its weights are absent.
    """
    a = read_arrays(path, f"{camera}_rgb", f"{camera}_frame", f"{camera}_render_seconds")
    depth_m = _stored_depth(path, camera)
    true = read_arrays(images, *(f"{camera}_{part}" for part in ("rgb", "valid", "frame", "time_s")))
    index = {frame: row for row, frame in enumerate(true[f"{camera}_frame"].tolist())}
    recorded = _Recorded(images, camera, true[f"{camera}_rgb"], true[f"{camera}_valid"], index)
    frames = a[f"{camera}_frame"].tolist()
    for i, frame in enumerate(frames):
        if frame not in index:
            raise StoreError(
                f"{path}: {camera} of frame {frame} is rendered, but {images} lacks it; run novel_views again"
            )
        rgb, truth = a[f"{camera}_rgb"][i], recorded.rgb[index[frame]]
        depth = _depth(None if depth_m is None else depth_m[i], recorded, scans, frame)
        found: dict[tuple[str, str], Mapping[str, Measure]] = {
            ("image", "all"): {**image_metrics(rgb, truth, recorded.valid, lpips), DEPTH_METRIC: depth[0]},
            ("lidar4d", "all"): {DEPTH_METRIC: depth[1]},
        }
        if boxes is not None:
            taken_s = float(true[f"{camera}_time_s"][index[frame]])
            here = boxes.in_camera(frame, taken_s, recorded.poses()[index[frame]])
            mask = box_rectangles(recorded.camera(), here)
            published = image_regions(rgb, truth, recorded.valid, mask, lpips)
            masked = masked_image_regions(rgb, truth, recorded.valid, mask)
            found |= {("image", region): measures for region, measures in published.items()}
            found |= {("masked", region): measures for region, measures in masked.items()}
        seconds = float(a[f"{camera}_render_seconds"][i])
        for (protocol, region), measures in found.items():
            ledger.add(
                measures, protocol=protocol, region=region, sensor=camera, frame=frame, render_seconds=seconds
            )
        yield f"frame {frame} ({i + 1} of {len(frames)})"


def _depth(
    predicted_m: np.ndarray | None, recorded: _Recorded, scans: RecordedScans | None, frame: int
) -> tuple[Measure, Measure]:
    """`image_depth_rmse_m` by our definition (along each pixel's ray) and as published (z)."""
    if predicted_m is None:
        return NO_DEPTH, NO_DEPTH
    if scans is None or frame not in scans.arrays["frame"]:
        return _NO_LIDAR, _NO_LIDAR
    world_to_camera = invert_pose(recorded.poses()[recorded.row[frame]])
    points_m = transform_points(world_to_camera, scans.world_points(frame))
    length_m, z_m = lidar_depth_images(points_m, recorded.camera())
    return ray_depth_rmse(predicted_m, length_m), published_depth_rmse(predicted_m, z_m)


def _stored_depth(path: Path, camera: str) -> np.ndarray | None:
    """(k, H, W) length of each pixel's ray, metres; None if the method stores none."""
    name = f"{camera}_range_m"
    return read_arrays(path, name)[name] if holds_array(path, name) else None
