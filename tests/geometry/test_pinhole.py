import numpy as np
import pytest

from nvsf_core.errors import CalibrationError, ShapeError
from nvsf_core.geometry.pinhole import Pinhole

CAMERA = Pinhole(fx=552.6, fy=550.1, cx=682.0, cy=238.8, width=1408, height=376)


def test_projecting_a_ray_gives_its_pixel_back() -> None:
    pixels = CAMERA.pixels()
    rays = CAMERA.rays(pixels)
    again, inside = CAMERA.project(rays * np.random.default_rng(0).uniform(0.1, 200, (*rays.shape[:2], 1)))
    assert inside.all()
    np.testing.assert_allclose(again, pixels, atol=1e-9)


def test_rays_are_unit_and_the_principal_point_looks_forward() -> None:
    np.testing.assert_allclose(np.linalg.norm(CAMERA.rays(CAMERA.pixels()), axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(CAMERA.rays(np.array([682.0, 238.8])), [0, 0, 1], atol=1e-15)


def test_points_behind_or_at_the_camera_have_no_pixel() -> None:
    pixels, inside = CAMERA.project(np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]]))
    assert np.isnan(pixels).any(axis=-1).all()
    assert not inside.any()


def test_a_pixel_is_inside_up_to_half_a_pixel_beyond_the_centres() -> None:
    edges = np.array([[-0.5, 0.0], [1407.49, 375.49], [1407.5, 0.0], [0.0, -0.51]])
    _, inside = CAMERA.project(CAMERA.rays(edges + [[1e-9, 0]] * 4))
    assert inside.tolist() == [True, True, False, False]


def test_what_is_no_camera_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"expected focal lengths of .* found 0 and 1$"):
        Pinhole(fx=0.0, fy=1.0, cx=0.0, cy=0.0, width=4, height=4)
    with pytest.raises(CalibrationError):
        Pinhole(fx=float("nan"), fy=1.0, cx=0.0, cy=0.0, width=4, height=4)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ShapeError):
        CAMERA.rays(np.zeros((4, 3)))
    with pytest.raises(ShapeError):
        CAMERA.project(np.zeros((4, 2)))
