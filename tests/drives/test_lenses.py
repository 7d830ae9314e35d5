"""Distorted images are rectified: what a pinhole of the new intrinsics sees."""

import cv2
import numpy as np
import pytest

from nvsf_core.drives.lenses import lens_of
from nvsf_core.errors import CalibrationError

FLAT = {"width": 160, "height": 120, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 60.0}


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("pinhole", {"k1": -0.3, "k2": 0.1, "p1": 1e-3, "p2": -1e-3, "k3": -0.01}),
        ("fisheye", {"k1": 0.05, "k2": -0.01, "k3": 0.0, "k4": 0.0}),
    ],
)
def test_a_point_is_seen_where_the_new_pinhole_has_it(model, distortion):
    lens = lens_of({"model": model, **FLAT, "distortion": distortion}, "front")
    matrix = np.array([[100.0, 0, 80.0], [0, 100.0, 60.0], [0, 0, 1.0]])
    points = np.array([[[0.2, -0.15, 1.0]], [[-0.3, 0.2, 1.0]]])
    values, none = np.array(list(distortion.values())), np.zeros(3)
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    seen, _ = project(points, none, none, matrix, values)
    image = np.zeros((120, 160, 3), np.uint8)
    rows, columns = np.mgrid[0:120, 0:160]
    for (u, v), shade in zip(seen.reshape(-1, 2), (0, 1), strict=True):
        image[..., shade] = np.clip(255.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18.0), 0, 255)
    image[..., 2] = 90
    flat = lens.rectified(image)
    pixels, inside = lens.intrinsics.project(points.reshape(-1, 3))
    assert inside.all() and flat[..., 2].min() == 90, "every pixel of the pinhole is one that the lens saw"
    for k, (u, v) in enumerate(pixels):
        row, column = np.unravel_index(flat[..., k].argmax(), flat.shape[:2])
        assert abs(row - v) <= 1.0 and abs(column - u) <= 1.0


def test_a_camera_without_distortion_is_used_as_it_is():
    lens = lens_of(FLAT, "front")
    assert lens.maps is None and lens.intrinsics.matrix[0, 2] == 80.0


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"model": "sphere"}, "model: expected one of pinhole, fisheye, mei"),
        ({"fx": None}, "fx: expected a number"),
        ({"width": 10.5}, "width: expected a whole number"),
        ({"distortion": {"k9": 1.0}}, "distortion: expected numbers k1"),
        ({"fx": -5.0}, "front: "),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(values, reason):
    with pytest.raises(CalibrationError, match=reason):
        lens_of({**FLAT, **values}, "front")
