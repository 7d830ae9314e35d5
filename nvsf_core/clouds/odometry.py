"""The path that scans themselves show, by KISS-ICP (Vizzo et al., RA-L 2023) where it is installed."""

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from nvsf_core.errors import DataError, MissingLibraryError
from nvsf_core.geometry.se3 import exp_se3, log_se3, poses_in

_FAR_M = 100.0
_LEAST_POINTS = 100
_VOXEL_M = 1.0
"""KISS-ICP's own choice: a hundredth of the range."""

NO_KISS_ICP = "KISS-ICP cannot be loaded"
"""Said of all that was not measured for want of it."""


def odometry_path(
    scans: Iterable[tuple[np.ndarray, np.ndarray]], first_step: np.ndarray | None = None
) -> np.ndarray:
    """Poses (n, 4, 4) of consecutive scans at their instants, metres; the first is the identity.

    KISS-ICP moves each scan's points to where the sensor was at the scan's last one, by the step before, and
    finds the pose of that moment. Half a sweep lies between it and the scan's instant: where the car pitches
    or brakes, the steps from end to end are others than those from instant to instant.

    Args:
        scans: Of each its points (m, 3) in the sensor's frame at firing time, metres, and their times (m,),
            in sweeps after its instant.
        first_step: (4, 4) motion from one scan to the next at the start; None = the sensor stands.

    Raises:
        DataError: A scan has too few points, or one that is not finite.
        MissingLibraryError: KISS-ICP is not installed; the message says how to install it.
    """
    odometry: Any = None
    poses = []
    for number, (points_m, fraction) in enumerate(scans):
        # KISS-ICP ends the process on what it cannot register.
        if len(points_m) < _LEAST_POINTS or not np.isfinite(points_m).all():
            raise DataError(
                f"odometry: expected {_LEAST_POINTS} or more finite points a scan, found {len(points_m)}, "
                f"{int((~np.isfinite(points_m)).sum())} numbers not finite, in scan {number}; leave it out"
            )
        if odometry is None:
            odometry = _kiss_icp()
            odometry.last_delta = odometry.last_delta if first_step is None else first_step
        # Without times the scan is taken to be of one instant; equal times would end the process.
        times = fraction.astype(np.float64) + 0.5 if np.ptp(fraction) > 0.0 else np.zeros(0)
        step = np.array(odometry.last_delta)
        odometry.register_frame(np.ascontiguousarray(points_m, np.float64), times)
        # By the very step that its points were moved by: so an instant is right even where that step is not.
        poses.append(odometry.last_pose @ _back_to_instant(step, fraction))
    return poses_in(poses[0], np.stack(poses)) if poses else np.zeros((0, 4, 4))


def _back_to_instant(step: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Motion (4, 4) from a scan's last point to its instant, as KISS-ICP takes the sensor to have moved.

    `step` (4, 4) is the motion between the two; `fraction` (m,) times of the points, in sweeps after it.
    """
    length = np.ptp(fraction)
    share = fraction.max() / length if length > 0.0 else 0.0
    return np.asarray(exp_se3(-share * log_se3(step[None]))[0])


def load_kiss_icp() -> tuple[Any, Any]:
    """KISS-ICP's modules of its configuration and of its algorithm.

    Raises:
        MissingLibraryError: It is not installed; the message says how to install it.
    """
    try:
        config_module = importlib.import_module("kiss_icp.config")
        odometry_module = importlib.import_module("kiss_icp.kiss_icp")
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"not run: {NO_KISS_ICP} ({error}); `pip install 'nvsf[odometry]'` installs it"
        ) from error
    return config_module, odometry_module


def _kiss_icp() -> Any:
    config_module, odometry_module = load_kiss_icp()
    config = config_module.KISSConfig()
    config.data.max_range = _FAR_M
    config.mapping.voxel_size = _VOXEL_M
    config.registration.max_num_threads = 1  # the same poses on every machine
    return odometry_module.KissICP(config)
