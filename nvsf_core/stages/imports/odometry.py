"""Poses of a drive that has none: KISS-ICP on its scans, refined, and how well they agree."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.clouds.odometry import odometry_path
from nvsf_core.clouds.path_refinement import FARTHEST_REACH, RefinedPath, refine_path
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.posed import AbstractPosedDrive, PosePath
from nvsf_core.errors import DataError
from nvsf_core.sensors.sweep import sweep_fraction

_START_SCANS = 8
_LEAST_OF_STEP = 0.5
"""Least share of the step between scans that a sweep lasts, for its points' times to be used."""
_COMPARED = 4000
_NEAR_M, _FAR_M = 3.0, 40.0
_OVERLAP_M = 0.3


def found_path(source: AbstractPosedDrive, progress: Callable[[str], None]) -> tuple[PosePath, str]:
    """The path of a drive's LiDAR by its scans, and its quality in words.

    Frames whose scan cannot be read have no pose. The path starts at the origin, level as the sensor was.

    Raises:
        DataError: Fewer than two scans can be read, or one has too few points.
        MissingLibraryError: KISS-ICP is not installed.
    """
    kept: dict[int, np.ndarray] = {}

    def scans() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in source.frames:
            scan = _readable(source, frame)
            if scan is None:
                continue
            progress(f"odometry: frame {frame}")
            points_m = scan.points[:, :3]
            kept[frame] = points_m[:: max(1, len(points_m) // _COMPARED)]
            yield points_m, times_in_sweeps(source, scan)

    found = path_of_scans(scans)
    moments = [source.instant_s(frame) for frame in kept]
    time_s = np.array([0.0 if one is None else one for one in moments])
    lidar_to_pose = source.calibration().lidar_to_pose
    path = PosePath(time_s, found.poses @ np.linalg.inv(lidar_to_pose), source.scene.root)
    return path, f"{_quality(list(kept.values()), found.poses, time_s)}; {_refinement(found)}"


def path_of_scans(scans: Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]]) -> RefinedPath:
    """KISS-ICP's path through consecutive scans, refined by what several of them saw.

    Args:
        scans: Begins to read them: points (m, 3) in metres, times (m,) in sweeps. It is called three times.

    Raises:
        DataError: There are fewer than two scans, or one has too few points.
        MissingLibraryError: KISS-ICP is not installed.
    """
    return refine_path(scans(), kiss_path(scans))


def kiss_path(scans: Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]]) -> np.ndarray:
    """KISS-ICP's path (n, 4, 4); arguments and errors as `path_of_scans`'s."""
    # KISS-ICP takes a sensor to stand at first. One that drives already is lost for some scans, so the motion
    # after these is what the path is started with.
    start = odometry_path(itertools.islice(scans(), _START_SCANS))
    if len(start) < 2:
        raise DataError(f"expected two or more scans to find poses from, found {len(start)}")
    return odometry_path(scans(), np.linalg.inv(start[-2]) @ start[-1])


def _refinement(found: RefinedPath) -> str:
    return (
        f"refined by scans up to {FARTHEST_REACH} frames apart: their points lie {found.after_m:.3f} m from "
        f"each other's planes in the median, {found.before_m:.3f} m before, with all rays turned up by "
        f"{np.degrees(found.elevation_rad):.2f} degrees"
    )


def _readable(source: AbstractPosedDrive, frame: int) -> Scan | None:
    try:
        scan = source.decode_scan(frame)
    except DataError:
        return None  # named where the frame itself is read
    return None if scan is None else source.centred(scan)


def times_in_sweeps(source: AbstractPosedDrive, scan: Scan) -> np.ndarray:
    """Times (m,) of a scan's points after its instant, in sweeps; 0 where scans are compensated already.

    They are 0, too, where sweeps are much shorter than the step between them, as of key frames: KISS-ICP
    takes the motion of a whole step to lie between a scan's first point and its last.

    Raises:
        DataError: The drive's times cannot be read.
    """
    if not source.scene.is_to_compensate:
        return np.zeros(len(scan.points))
    times = source.times()
    period_s, steps_s = times.sweep_period_s, np.diff(times.time_s)
    if len(steps_s) and period_s < _LEAST_OF_STEP * float(np.median(steps_s)):
        return np.zeros(len(scan.points))
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
