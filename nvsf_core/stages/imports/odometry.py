"""Poses of a drive that has none: KISS-ICP on its scans, and how well they agree."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.clouds.odometry import odometry_path
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.posed import AbstractPosedDrive, PosePath
from nvsf_core.errors import DataError
from nvsf_core.sensors.sweep import sweep_fraction

_START_SCANS = 8
_COMPARED = 4000
_NEAR_M, _FAR_M = 3.0, 40.0
_OVERLAP_M = 0.3


def found_path(source: AbstractPosedDrive, progress: Callable[[str], None]) -> tuple[PosePath, str]:
    """The path of a drive's LiDAR by its scans, and its quality in words.

    Frames whose scan cannot be read have no pose. The path starts at the origin, level as the sensor was.

    Args:
        source: The drive.
        progress: Receives progress lines.

    Raises:
        DataError: Fewer than two scans can be read, or one has too few points.
        MissingLibraryError: KISS-ICP is not installed.
    """
    frames: list[int] = []
    kept: list[np.ndarray] = []
    period_s = source.times().sweep_period_s

    def scans() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in source.frames:
            scan = _readable(source, frame)
            if scan is None:
                continue
            progress(f"odometry: frame {frame}")
            frames.append(frame)
            points_m = scan.points[:, :3]
            kept.append(points_m[:: max(1, len(points_m) // _COMPARED)])
            yield points_m, _fraction(scan, period_s)

    # KISS-ICP takes a sensor to stand at first. One that drives already is lost for some scans, so the motion
    # after these is what the path is started with.
    start = odometry_path(itertools.islice(scans(), _START_SCANS))
    frames.clear()
    kept.clear()
    poses = odometry_path(scans(), _last_step(start))
    if len(frames) < 2:
        raise DataError(
            f"{source.scene.root}: expected two or more scans to find poses from, found {len(frames)}"
        )
    moments = [source.instant_s(frame) for frame in frames]
    time_s = np.array([0.0 if one is None else one for one in moments])
    lidar_to_pose = source.calibration().lidar_to_pose
    path = PosePath(time_s, poses @ np.linalg.inv(lidar_to_pose), source.scene.root)
    return path, _quality(kept, poses, time_s)


def _last_step(poses: np.ndarray) -> np.ndarray | None:
    """(4, 4) motion between the last two of poses (n, 4, 4)."""
    return np.asarray(np.linalg.inv(poses[-2]) @ poses[-1]) if len(poses) > 1 else None


def _readable(source: AbstractPosedDrive, frame: int) -> Scan | None:
    try:
        scan = source.decode_scan(frame)
    except DataError:
        return None  # named where the frame itself is read
    return None if scan is None else source.centred(scan)


def _fraction(scan: Scan, period_s: float) -> np.ndarray:
    if scan.offset_s is not None and period_s > 0.0:
        return scan.offset_s / period_s
    return sweep_fraction(np.arctan2(scan.points[:, 1].astype(np.float64), scan.points[:, 0]))


def _quality(kept: list[np.ndarray], poses: np.ndarray, time_s: np.ndarray) -> str:
    """How well consecutive scans agree under the path, and how fast it is."""
    apart, shares = [], []
    for k in range(len(kept) - 1):
        step = np.linalg.inv(poses[k]) @ poses[k + 1]
        moved = kept[k + 1] @ step[:3, :3].T + step[:3, 3]
        range_m = np.linalg.norm(moved, axis=1)
        moved = moved[(range_m > _NEAR_M) & (range_m < _FAR_M)]
        if len(moved) == 0 or len(kept[k]) == 0:
            continue
        distance_m, _ = cKDTree(kept[k]).query(moved)
        apart.append(float(np.median(distance_m)))
        shares.append(float((distance_m < _OVERLAP_M).mean()))
    steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    fastest = float((steps_m / np.diff(time_s)).max(initial=0.0))
    return (
        f"poses found from {len(kept)} scans by KISS-ICP: {steps_m.sum():.1f} m, at most "
        f"{fastest:.1f} m/s; thinned consecutive scans lie "
        f"{np.median(apart or [np.nan]):.3f} m apart in the median, "
        f"{min(shares, default=float('nan')):.0%} within {_OVERLAP_M:g} m at the worst step"
    )
