from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.cameras.masks import lens_circle
from nvsf_core.cameras.undistort import make_undistorter
from nvsf_core.errors import ShapeError
from nvsf_core.geometry.fisheye import MeiFisheye, perspective_view

REAL = MeiFisheye(
    2.2134047507854890, 1.6798235660113681e-02, 1.6548773243373522, 4.2223943394772046e-04,
    4.2462134260997584e-04, 1336.3220825849971, 1335.7883350012958, 716.94323510126321, 705.76498308221585,
    1400, 1400,
)  # fmt: skip
SMALL = MeiFisheye(2.2, 0.017, 1.65, 4e-4, 4e-4, 334.0, 334.0, 175.0, 175.0, 350, 350)


def test_the_rectification_map_is_our_own_projection() -> None:
    view = perspective_view(REAL)
    undistorter = make_undistorter(REAL, view)
    pixels, inside = REAL.project(view.rays(view.pixels()))
    assert np.abs(undistorter.map_u - pixels[..., 0]).max() < 1e-3
    assert np.abs(undistorter.map_v - pixels[..., 1]).max() < 1e-3
    assert undistorter.valid.all() and inside.all()


def test_the_view_keeps_the_height_and_the_field_of_view() -> None:
    view = perspective_view(SMALL)
    assert (view.width, view.height) == (350, 350)
    left = view.rays(np.array([-0.5, view.cy]))
    assert np.degrees(np.arctan2(-left[0], left[2])) == pytest.approx(45.0)
    assert perspective_view(REAL).width == 1000


def test_a_straight_line_in_the_world_comes_out_straight() -> None:
    view = perspective_view(SMALL)
    image = np.zeros((350, 350, 3), np.uint8)
    line = np.stack([np.linspace(-3, 3, 4000), np.full(4000, 1.1), np.full(4000, 2.4)], axis=-1)
    pixels = SMALL.project(line)[0]
    for u, v in np.round(pixels[SMALL.project(line)[1]]).astype(int):
        image[v - 1 : v + 2, u - 1 : u + 2] = 255
    seen = make_undistorter(SMALL, view).apply(image)[..., 0].astype(float)
    columns = np.flatnonzero(seen.sum(axis=0) > 0)
    rows = (seen * np.arange(350)[:, None]).sum(axis=0)[columns] / seen.sum(axis=0)[columns]
    assert len(columns) > 300
    assert np.abs(rows - (view.fy * 1.1 / 2.4 + view.cy)).max() < 1.0


def test_pixels_beyond_the_source_are_invalid_and_black() -> None:
    view = replace(perspective_view(SMALL), fx=30.9, fy=30.9)  # 160 degrees
    narrow = MeiFisheye(2.2, 0.017, 1.65, 4e-4, 4e-4, 334.0, 334.0, 100.0, 175.0, 200, 350)
    undistorter = make_undistorter(narrow, view)
    seen = undistorter.apply(np.full((350, 200, 3), 200, np.uint8))
    assert not undistorter.valid.all()
    assert (seen[undistorter.valid] >= 199).all()
    assert (seen[~undistorter.valid] == 0).all()


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ShapeError, match="350, 350"):
        make_undistorter(SMALL, perspective_view(SMALL)).apply(np.zeros((10, 10, 3), np.uint8))


def test_the_lens_circle_leaves_dark_objects_inside_valid() -> None:
    images = np.full((40, 40, 3), 100, np.uint8)
    rows, columns = np.mgrid[:40, :40]
    outside = (rows - 20) ** 2 + (columns - 20) ** 2 > 19**2
    images[outside] = 2
    images[15:20, 15:20] = 0
    np.testing.assert_array_equal(lens_circle(images), ~outside)
