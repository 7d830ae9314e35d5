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


WIDE = {"width": 320, "height": 180, "fx": 130.0, "fy": 130.0, "cx": 160.0, "cy": 90.0}
"""OpenCV's own pinhole of this lens sees 6 % beyond the image."""
FISHEYES = {
    "beyond 180 degrees": ({"width": 250, "height": 250, "fx": 71.5, "cx": 125.0, "cy": 125.0}, {}),
    "RealSense T265": (
        {"width": 212, "height": 200, "fx": 71.5, "cx": 104.2, "cy": 100.8},
        {"k1": -0.0066, "k2": 0.0425, "k3": -0.0406, "k4": 0.0075},
    ),
    "axis aside": ({"width": 320, "height": 240, "fx": 95.0, "cx": 175.0, "cy": 107.5}, {"k1": -0.02}),
}


def _reads_outside_px(lens, size_px) -> float:
    """How far outside the recorded image the farthest pixel is read."""
    across, down = lens.maps
    last = np.array(size_px) - 1.0
    return max(
        float(np.abs(one - np.clip(one, 0.0, end)).max())
        for one, end in zip((across, down), last, strict=True)
    )


@pytest.mark.parametrize(
    ("camera", "distortion"),
    [
        (WIDE, {"k1": -0.32, "k2": 0.1}),
        ({**WIDE, "fx": 120.0, "fy": 120.0}, {"k1": -0.32, "k2": 0.1}),
        ({**WIDE, "fx": 200.0, "fy": 200.0, "cx": 225.0, "cy": 50.0}, {"k1": -0.3, "k2": 0.1}),
        (WIDE, {"k1": -0.4}),
    ],
    ids=["wide", "wider", "axis aside", "folds the plane"],
)
def test_of_a_wide_lens_no_pixel_repeats_the_image_s_border(camera, distortion):
    lens = lens_of({**camera, "distortion": distortion}, "front")
    assert _reads_outside_px(lens, (320, 180)) < 0.01
    across, down = lens.maps
    assert (np.diff(across, axis=1) > 0.0).all() and (np.diff(down, axis=0) > 0.0).all(), (
        "nothing is mirrored"
    )
    field_deg = np.degrees(2.0 * np.arctan(160.0 / lens.intrinsics.fx))
    assert field_deg > 60.0, "most of what it saw is still there"


@pytest.mark.parametrize("name", list(FISHEYES))
def test_a_wide_fisheye_is_shown_90_degrees_about_its_axis(name):
    camera, distortion = FISHEYES[name]
    lens = lens_of({"model": "fisheye", **camera, "fy": camera["fx"], "distortion": distortion}, "front")
    size_px = camera["width"], camera["height"]
    seen = lens.intrinsics
    assert (seen.width, seen.height) == size_px and seen.fx == pytest.approx(seen.fy)
    assert np.degrees(2.0 * np.arctan((min(size_px) - 1) / 2 / seen.fy)) == pytest.approx(90.0)
    assert (seen.cx, seen.cy) == pytest.approx((np.array(size_px) - 1) / 2)
    assert _reads_outside_px(lens, size_px) == 0.0
    middle = tuple(round((side - 1) / 2) for side in reversed(size_px))
    assert lens.maps[0][middle] == pytest.approx(camera["cx"], abs=1.0)


def test_cameras_that_opencv_rectifies_well_are_left_to_it():
    """KITTI raw's, EuRoC's and a fisheye of 117 degrees, as they have always been read."""
    for model, size_px, (fx, fy, cx, cy), values in (
        ("pinhole", (1392, 512), (984.2, 980.8, 690.0, 233.2), (-0.3728, 0.2037, 0.00222, 0.00138, -0.0723)),
        ("pinhole", (752, 480), (458.654, 457.296, 367.215, 248.375), (-0.2834, 0.07396, 0.000194, 1.76e-5)),
        ("fisheye", (1280, 800), (500.0, 500.0, 640.0, 400.0), (0.02, -0.01, 0.003, -0.001)),
    ):
        names = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
        given = dict(zip(names, values, strict=False))
        raw = {"width": size_px[0], "height": size_px[1], "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        lens = lens_of({"model": model, **raw, "distortion": given}, "front")
        matrix, known = (
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
            np.zeros(4 if model == "fisheye" else 8),
        )
        known[: len(values)] = values
        if model == "fisheye":
            theirs = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                matrix, known, size_px, np.eye(3), balance=0.0
            )
        else:
            theirs, _ = cv2.getOptimalNewCameraMatrix(matrix, known, size_px, 0.0, size_px)
        assert np.array_equal(lens.intrinsics.matrix, theirs)


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
        ({"distorsion": {"k1": -0.3}}, "front: expected the keys of a pinhole, .*distortion.*'distorsion'"),
        ({"xi": 1.0}, "front: expected the keys of a pinhole, .* found 'xi'; correct it"),
        ({"fx": -5.0}, "front: "),
        ({"height": 1, "cy": 0.0}, "front: expected an image of at least 8 x 8 pixels, found 160 x 1; leave"),
        ({"height": 7, "distortion": {"k1": -0.1}}, "front: .* found 160 x 7"),
        ({"model": "fisheye", "width": 7, "fx": 5.0, "cx": 3.0}, "front: .* found 7 x 120"),
        ({"distortion": {"k1": -60.0}}, "front: distortion: expected one by which a pinhole"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(values, reason):
    with pytest.raises(CalibrationError, match=reason):
        lens_of({**FLAT, **values}, "front")
