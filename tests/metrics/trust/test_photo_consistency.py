"""A wall that is seen from several places: what an image carried back into the others must find."""

import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics.trust.photo_consistency import (
    ParallaxCurve,
    expected_difference,
    fill_difference,
    look_back,
    nearest_difference,
    parallax_curve,
)
from nvsf_core.recording.images import CameraImages

CAMERA = Pinhole(fx=60.0, fy=60.0, cx=39.5, cy=19.5, width=80, height=40)
WALL_M = 10.0
ALL = np.arange(CAMERA.height * CAMERA.width)


def _pose(x_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def _wall(x_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Image and ranges of a wall with smooth waves, from x_m."""
    rays = CAMERA.rays(CAMERA.pixels())
    range_m = WALL_M / rays[..., 2]
    place = rays * range_m[..., None] + [x_m, 0.0, 0.0]
    waves = [0.5 + 0.4 * np.sin(2.0 * place[..., 0] + k) * np.cos(1.5 * place[..., 1]) for k in range(3)]
    return np.rint(255.0 * np.stack(waves, axis=-1)).astype(np.uint8), range_m


def _recorded(*x_m: float) -> CameraImages:
    return CameraImages(CAMERA, np.stack([_wall(x)[0] for x in x_m]), np.stack([_pose(x) for x in x_m]), ALL)


def test_an_image_with_its_true_depth_agrees_and_one_with_a_wrong_depth_does_not() -> None:
    rgb, range_m = _wall(0.5)
    recorded = _recorded(0.0, 2.0)
    right = nearest_difference(look_back(rgb, range_m, _pose(0.5), recorded))
    wrong = nearest_difference(look_back(rgb, 0.7 * range_m, _pose(0.5), recorded))
    shown = np.isfinite(right)
    assert shown.mean() > 0.9
    assert np.sqrt(right[shown].mean()) < 0.01
    assert np.sqrt(wrong[np.isfinite(wrong)].mean()) > 0.05


def test_the_nearest_image_is_that_of_the_most_similar_direction_and_what_none_shows_is_infinite() -> None:
    rgb, range_m = _wall(0.5)
    looks = [look_back(rgb, range_m, _pose(0.5), _recorded(*x_m)) for x_m in ((0.4,), (0.4, 3.0))]
    nearest = [nearest_difference(look) for look in looks]
    both = np.isfinite(nearest[0])
    assert (nearest[0][both] == nearest[1][both]).all()
    middle = (CAMERA.height // 2) * CAMERA.width + 40
    expected_rad = np.arctan(0.1 / WALL_M)
    assert looks[0].parallax_rad[0, middle] == pytest.approx(expected_rad, rel=0.02)
    turned = _pose(0.5)
    turned[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    assert np.isinf(nearest_difference(look_back(rgb, range_m, turned, _recorded(0.4)))).all()


def test_what_recorded_images_differ_by_never_falls_with_parallax_and_guesses_get_at_least_the_fill() -> None:
    draws = np.random.default_rng(3)
    recorded = _recorded(0.0, 0.3, 1.0, 3.0)
    noisy = CameraImages(CAMERA, draws.integers(0, 255, recorded.rgb.shape).astype(np.uint8),
                         recorded.pose, ALL)  # fmt: skip
    rgb, range_m = _wall(0.5)
    look = look_back(rgb, range_m, _pose(0.5), noisy)
    curve = parallax_curve([look], [0.5])
    assert curve is not None
    assert (np.diff(curve.squared) >= 0.0).all()
    rising = ParallaxCurve(np.linspace(0.0, 0.09, 10), 0.04)
    nothing, everything = (np.full(range_m.shape, one) for one in (False, True))
    known, guessed = (expected_difference(look, one, rising) for one in (nothing, everything))
    assert (guessed >= np.maximum(known, 0.04)).all()
    assert known.min() < 0.04


def test_the_fill_is_what_pixels_sixteen_apart_differ_by() -> None:
    stripes = np.zeros((4, 64, 3), np.uint8)
    stripes[:, (np.arange(64) // 16) % 2 == 1] = 255
    assert fill_difference(stripes, np.ones((4, 64), bool)) == 1.0
    assert np.isnan(fill_difference(stripes[:, :10], np.ones((4, 10), bool)))


def test_an_image_of_another_size_is_refused() -> None:
    rgb, range_m = _wall(0.0)
    with pytest.raises(DataError, match=r"expected an image .* \(40, 80\) .* found \(40, 79, 3\)"):
        look_back(rgb[:, :-1], range_m, _pose(0.0), _recorded(0.0))
