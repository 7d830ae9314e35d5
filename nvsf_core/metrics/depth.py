"""Errors of camera depth at the LiDAR returns that project into the image."""

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics.elementwise import rmse, same_shape
from nvsf_core.metrics.measure import Measure, absent, undefined
from nvsf_core.sensors.linear_pano import project_nearest

CAP_M = 80.0
"""Depths beyond it count as equal to it."""
NO_DEPTH = absent("this model stores no camera depth")
"""The measure of a model that renders no camera depth."""


def lidar_depth_images(points_m: np.ndarray, camera: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Images of the nearest return in each pixel.

    Args:
        points_m: (N, 3) returns, camera frame.
        camera: The camera.

    Returns:
        Ray length and z, (H, W) float32 each, metres; 0 = no return.
    """
    pixels, seen = camera.project(points_m)
    column, row = np.rint(pixels[seen]).astype(np.int64).T
    length_m = np.linalg.norm(points_m[seen].astype(np.float64), axis=1)
    depth_m = points_m[seen, 2].astype(np.float64)
    return project_nearest(row, column, length_m, depth_m, (camera.height, camera.width))


def ray_depth_rmse(predicted_m: np.ndarray, truth_m: np.ndarray) -> Measure:
    """`image_depth_rmse_m`: root mean square difference of ray lengths (H, W), metres, at the returns.

    Both sides are capped at 80 m; a pixel without a depth (0 or infinite) counts as 80 m.
    """
    same_shape(predicted_m, truth_m)
    there = truth_m > 0.0
    if not there.any():
        return undefined("no LiDAR return falls into the image")
    predicted = predicted_m[there].astype(np.float64)
    predicted = np.where(predicted == 0.0, CAP_M, np.minimum(predicted, CAP_M))
    return rmse(predicted, np.minimum(truth_m[there].astype(np.float64), CAP_M))


def published_depth_rmse(predicted_m: np.ndarray, truth_z_m: np.ndarray) -> Measure:
    """`image_depth_rmse_m` as NVSF publishes it: the mean includes all pixels without a return.

    The rendered ray length (H, W), inf = no depth, set to 0 where there is no return, is compared with z of
    `lidar_depth_images`, over all pixels, both capped at 80 m. So the error shrinks with the share of pixels
    that have a return, and a perfect model has an error, because ray length is z divided by the cosine of the
    angle to the optical axis.
    """
    same_shape(predicted_m, truth_z_m)
    predicted = np.where(truth_z_m > 0.0, np.minimum(predicted_m.astype(np.float64), CAP_M), 0.0)
    return rmse(predicted, np.minimum(truth_z_m.astype(np.float64), CAP_M))
