"""Means over windows are those that are computed window by window."""

import numpy as np
import pytest

from nvsf_core.kernels.images.window_mean import window_mean


@pytest.mark.parametrize(
    ("shape", "reach"), [((13, 17), 2), ((13, 17), 5), ((3, 20), 4), ((1, 1), 3), ((9, 2), 1)]
)
def test_each_value_is_the_mean_of_its_window_with_zeros_beyond_the_border(
    shape: tuple[int, int], reach: int
) -> None:
    plane = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    padded, side = np.pad(plane, reach), 2 * reach + 1
    expected = np.lib.stride_tricks.sliding_window_view(padded, (side, side)).mean(axis=(2, 3))
    window_mean(plane, reach)
    np.testing.assert_allclose(plane, expected, atol=1e-6)
