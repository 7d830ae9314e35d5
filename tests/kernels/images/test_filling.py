"""The nearest known pixel and medians, against scipy's."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, median_filter

from nvsf_core.kernels.images.filling import median_of_7, nearest_known

SHAPES = [(40, 70), (3, 5), (1, 9), (9, 1)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.001, 0.04, 0.5])
def test_the_nearest_known_pixel_is_as_near_as_scipy_says(shape: tuple[int, int], share: float) -> None:
    rng = np.random.default_rng(0)
    known = rng.random(shape) < share
    known[tuple(rng.integers(shape))] = True
    gap_px, where = nearest_known(known)
    assert np.allclose(gap_px, distance_transform_edt(~known), atol=1e-4)
    assert known[where[0], where[1]].all()
    assert np.allclose(np.hypot(*(where - np.indices(shape))), gap_px, atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_medians_are_scipy_s_to_the_bit(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(1).random(shape).astype(np.float32)
    image[:1] = np.inf
    along = median_filter(image, size=(7, 1))
    assert np.array_equal(median_of_7(image), median_filter(along, size=(1, 7)))
