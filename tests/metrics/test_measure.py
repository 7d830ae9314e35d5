"""What makes a metric undefined, and what is left out or clamped before metrics are taken."""

import math

import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.elementwise import same_shape
from nvsf_core.metrics.measure import absent, fault, undefined
from nvsf_core.metrics.norms import spread_distance, spread_limit
from nvsf_core.metrics.protocols import Scan, near_returns
from nvsf_core.metrics.range_and_intensity import clamped_intensity, clamped_range_m


def test_undefined_and_absent_measures_are_nan_with_a_reason() -> None:
    lost, missing = undefined("broken", 3), absent("no weights")
    assert math.isnan(lost.value) and math.isnan(missing.value)
    assert (lost.n_valid, lost.reason, lost.is_absent) == (3, "broken", False)
    assert (missing.n_valid, missing.reason, missing.is_absent) == (0, "no weights", True)


def test_a_sound_pair_has_no_fault() -> None:
    assert fault(np.zeros(2), np.ones(2)) is None


@pytest.mark.parametrize(
    ("predicted", "truth", "n_valid", "reason"),
    [
        ([], [], 0, "empty"),
        ([math.nan, 1.0, math.inf], [1.0, 1.0, 1.0], 1, "2 of 3 predicted"),
        ([1.0, 1.0], [-math.inf, 1.0], 1, "1 of 2 true"),
    ],
)
def test_empty_and_non_finite_pairs_are_undefined(predicted, truth, n_valid, reason) -> None:
    found = fault(np.array(predicted), np.array(truth))
    assert found is not None and math.isnan(found.value) and not found.is_absent
    assert found.n_valid == n_valid and reason in found.reason


def test_arrays_that_numpy_would_broadcast_are_refused() -> None:
    same_shape(np.zeros((2, 3)), np.ones((2, 3)))
    for shape in ((3,), (1, 3), (2, 3, 1)):
        with pytest.raises(ShapeError, match="equal shapes"):
            same_shape(np.zeros((2, 3)), np.ones(shape))


def test_ranges_and_intensities_are_clamped_copies_in_double_precision() -> None:
    range_m = np.array([[0.0, 5.0], [80.5, math.nan]], dtype=np.float32)
    clamped = clamped_range_m(range_m)
    np.testing.assert_array_equal(clamped, [[1e-6, 5.0], [80.0, math.nan]])
    assert clamped.dtype == np.float64 and range_m[0, 0] == 0.0
    np.testing.assert_array_equal(clamped_intensity(np.array([-1.0, 0.5, 2.0])), [1e-6, 0.5, 1.0])


def test_returns_beyond_80_m_and_at_the_sensor_are_left_out_and_nan_is_kept() -> None:
    points_m = np.array([[80.0, 0, 0], [0, 80.01, 0], [0, 0, 0], [math.nan, 1, 1], [3, 4, 0]])
    scan = Scan(points_m=points_m, intensity=np.arange(5) / 10.0, laser=np.arange(5))
    near = near_returns(scan)
    assert near.laser.tolist() == [0, 3, 4]
    np.testing.assert_array_equal(near.points_m, points_m[[0, 3, 4]])
    np.testing.assert_array_equal(near.intensity, [0.0, 0.3, 0.4])


def _all_at(level: int) -> np.ndarray:
    """Cumulative histogram of intensities that are all level / 100."""
    return (np.arange(101) >= level).astype(np.float64)


def test_the_limit_of_a_distribution_follows_the_recorded_ones() -> None:
    # Equal histograms at one level: no distance to the median's, and none between them; one step is left.
    assert spread_limit(np.stack([_all_at(40)] * 3)) == 0.01
    # Half of the intensities 0, half 1: the median's histogram is all at 0, half a unit away.
    halves = np.full(101, 0.5)
    halves[100] = 1.0
    assert spread_distance(halves, _all_at(0)) == pytest.approx(0.5)
    assert spread_limit(halves[None]) == pytest.approx(0.25)
    # Two recordings 0.6 apart: more than half of the distance to the median's histogram.
    apart = np.stack([_all_at(20), _all_at(80)])
    assert spread_distance(*apart) == pytest.approx(0.6)
    # The code takes the mean over 101 steps there, and the sum over 100 in `spread_distance`.
    assert spread_limit(apart) == pytest.approx(0.6, rel=0.01)
