import cv2
import numpy as np
import pytest

from nvsf_core.errors import CalibrationError, ShapeError
from nvsf_core.geometry.fisheye import MeiFisheye
from tests.conftest import SHARED

SAMPLE = SHARED / "data/kitti360_fisheye_sample"


def real_camera(name: str) -> MeiFisheye:
    path = SAMPLE / f"{name}.yaml"
    if not path.is_file():
        pytest.skip(f"no real fisheye calibration at {path}")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    mirror, lens, plane = (
        storage.getNode(f"{key}_parameters") for key in ("mirror", "distortion", "projection")
    )
    return MeiFisheye(
        xi=mirror.getNode("xi").real(),
        **{key: lens.getNode(key).real() for key in ("k1", "k2", "p1", "p2")},
        **{key: plane.getNode(key).real() for key in ("gamma1", "gamma2", "u0", "v0")},
        width=int(storage.getNode("image_width").real()),
        height=int(storage.getNode("image_height").real()),
    )


def directions(largest_deg: float, count: int = 20_000) -> np.ndarray:
    random = np.random.default_rng(3)
    angle = np.radians(random.uniform(0.0, largest_deg, count))
    turn = random.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)


@pytest.mark.parametrize("name", ["image_02", "image_03"])
@pytest.mark.parametrize("largest_deg", [95.0, 90.0])
def test_projection_agrees_with_opencv(name: str, largest_deg: float) -> None:
    camera = real_camera(name)
    rays = directions(largest_deg)
    if largest_deg == 90.0:  # exactly sideways, all round
        rays = np.concatenate([rays, np.stack([rays[:, 0], rays[:, 1], 0 * rays[:, 2]], -1)])
    expected, _ = cv2.omnidir.projectPoints(
        rays[:, None] * 7.0, np.zeros(3), np.zeros(3), camera.matrix, camera.xi, camera.distortion
    )
    pixels, _ = camera.project(rays * 7.0)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("name", ["image_02", "image_03"])
def test_unprojecting_a_projection_gives_the_direction_back(name: str) -> None:
    camera = real_camera(name)
    rays = directions(95.0)
    again, solved = camera.unproject(camera.project(rays)[0])
    assert solved.all()
    assert np.abs(again - rays).max() < 1e-11


def test_pixels_that_no_direction_reaches_are_unsolved() -> None:
    camera = real_camera("image_02")
    found, solved = camera.unproject(np.array([[-4000.0, 700.0], [1e9, 1e9], [716.9, 705.7]]))
    assert solved.tolist() == [False, False, True]
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2], [0, 0, 1], atol=1e-3)


def test_directions_behind_the_lens_have_no_pixel() -> None:
    camera = MeiFisheye(2.2, 0.017, 1.65, 4e-4, 4e-4, 334.0, 334.0, 175.0, 175.0, 350, 350)
    pixels, inside = camera.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    assert inside.tolist() == [False, False, True]


def test_what_is_no_fisheye_is_refused() -> None:
    with pytest.raises(CalibrationError, match="yaml"):
        MeiFisheye(float("nan"), 0, 0, 0, 0, 334.0, 334.0, 175.0, 175.0, 350, 350)
    camera = MeiFisheye(0.0, 0, 0, 0, 0, 334.0, 334.0, 175.0, 175.0, 350, 350)
    with pytest.raises(ShapeError):
        camera.project(np.zeros((3, 2)))
    with pytest.raises(ShapeError):
        camera.unproject(np.zeros((3, 3)))


def test_without_mirror_and_distortion_it_is_a_pinhole() -> None:
    camera = MeiFisheye(0.0, 0, 0, 0, 0, 300.0, 310.0, 175.0, 170.0, 350, 350)
    pixels, _ = camera.project(np.array([1.0, -2.0, 8.0]))
    np.testing.assert_allclose(pixels, [300 / 8 + 175, -310 * 2 / 8 + 170])
