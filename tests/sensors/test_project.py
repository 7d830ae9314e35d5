import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.sensors.linear_pano import nearest_in_cells, project_nearest


def test_nearest_matches_a_plain_loop():
    rng = np.random.default_rng(0)
    cell = rng.integers(0, 50, 1000)
    range_m = rng.integers(1, 20, 1000).astype(float)  # many ties
    expected = np.full(60, -1)
    for i in range(1000):
        if expected[cell[i]] < 0 or range_m[i] < range_m[expected[cell[i]]]:
            expected[cell[i]] = i
    np.testing.assert_array_equal(nearest_in_cells(cell, range_m, 60), expected)


def test_images_keep_the_nearest_return_and_its_value():
    row, column = np.array([0, 0, 1]), np.array([2, 2, 0])
    range_m, value = np.array([5.0, 3.0, 7.0]), np.array([0.1, 0.2, 0.3])
    image_m, values = project_nearest(row, column, range_m, value, (2, 3))
    np.testing.assert_array_equal(image_m, np.float32([[0, 0, 3], [7, 0, 0]]))
    np.testing.assert_array_equal(values, np.float32([[0, 0, 0.2], [0.3, 0, 0]]))


def test_no_returns_give_an_empty_image():
    nothing = np.zeros(0, np.int64)
    image_m, _ = project_nearest(nothing, nothing, np.zeros(0), np.zeros(0), (2, 3))
    assert not image_m.any()


def test_unequal_lengths_are_refused():
    with pytest.raises(ShapeError):
        nearest_in_cells(np.zeros(3, np.int64), np.zeros(2), 4)
