import math

import numpy as np
import pytest

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics.depth import lidar_depth_images, published_depth_rmse, ray_depth_rmse

CAMERA = Pinhole(fx=20.0, fy=20.0, cx=9.5, cy=7.5, width=20, height=16)


def _wall(distance_m: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Length of every pixel's ray to a wall across the view, and returns on every third pixel of it."""
    directions = CAMERA.rays(CAMERA.pixels())
    length_m = distance_m / directions[..., 2]
    points_m = (directions * length_m[..., None])[::3, ::3].reshape(-1, 3)
    return length_m, points_m


def test_the_exact_depth_has_no_error_at_the_lidars_pixels_and_the_published_one_has() -> None:
    length_m, points_m = _wall()
    ray_m, z_m = lidar_depth_images(points_m, CAMERA)
    assert np.count_nonzero(ray_m) == len(points_m)
    assert z_m[z_m > 0] == pytest.approx(10.0)
    assert ray_depth_rmse(length_m, ray_m).value == pytest.approx(0.0, abs=1e-5)
    # A perfect model is wrong as published: ray length is not z.
    assert published_depth_rmse(length_m, z_m).value > 0.1


def test_the_nearest_return_of_a_pixel_counts_and_returns_behind_the_camera_do_not() -> None:
    points_m = np.array([[0.0, 0.0, 9.0], [0.0, 0.0, 4.0], [0.0, 0.0, -2.0]])
    ray_m, _ = lidar_depth_images(points_m, CAMERA)
    assert ray_m[ray_m > 0].tolist() == [4.0]


def test_no_answer_counts_as_80_m_and_nothing_counts_where_no_return_is() -> None:
    ray_m = np.array([[10.0, 0.0]])
    assert ray_depth_rmse(np.array([[np.inf, 3.0]]), ray_m).value == pytest.approx(70.0)
    assert ray_depth_rmse(np.array([[0.0, 3.0]]), ray_m).value == pytest.approx(70.0)
    assert ray_depth_rmse(np.array([[11.0, 3.0]]), ray_m).n_valid == 1
    assert published_depth_rmse(np.array([[11.0, 3.0]]), ray_m).value == pytest.approx(math.sqrt(0.5))
    assert math.isnan(ray_depth_rmse(np.array([[1.0]]), np.array([[0.0]])).value)
    assert math.isnan(ray_depth_rmse(np.array([[np.nan, 1.0]]), ray_m).value)
