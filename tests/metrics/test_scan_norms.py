"""Limits of hit rates and intensities come from the training scans, by laws that need no drive."""

import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.metrics.norms import intensity_spread, scan_norms, spread_distance

LASERS, FIRINGS = 10, 100


def _norms(returns, intensity=None):
    offsets = np.concatenate([[0], np.cumsum(returns)])
    if intensity is None:
        intensity = np.random.default_rng(0).uniform(0.0, 1.0, int(offsets[-1]))
    count = len(returns)
    return scan_norms(np.arange(count, dtype=float), np.full(count, FIRINGS), LASERS, offsets, intensity)


@pytest.mark.parametrize(("one", "other"), [(0.2, 0.7), (0.0, 1.0), (0.5, 0.5)])
def test_two_brightnesses_are_as_far_apart_as_light_must_move(one, other):
    spreads = [intensity_spread(np.full(7, value)) for value in (one, other)]
    assert spread_distance(*spreads) == pytest.approx(abs(one - other), abs=1e-12)


def test_the_distance_is_that_of_scipy():
    from scipy.stats import wasserstein_distance

    draws = np.random.default_rng(1)
    one, other = (draws.integers(0, 101, 500) / 100 for _ in range(2))
    expected = wasserstein_distance(one, other)
    assert spread_distance(intensity_spread(one), intensity_spread(other)) == pytest.approx(expected)


@pytest.mark.parametrize("broken", [np.zeros(0), np.array([0.1, np.nan])])
def test_no_intensity_or_a_broken_one_is_refused(broken):
    with pytest.raises(DataError, match="expected finite"):
        intensity_spread(broken)


def test_an_empty_scan_is_beyond_the_limit_and_a_neighbours_rate_is_not():
    norms = _norms([900, 905, 910, 900])
    assert norms.hit_rate_limit == pytest.approx(0.5 * 0.0975)
    assert abs(norms.hit_rate_apart(0, 1.5)) > norms.hit_rate_limit
    assert abs(norms.hit_rate_apart(903, 1.5)) < norms.hit_rate_limit


def test_every_ray_returning_is_beyond_the_limit_too():
    norms = _norms([900, 905, 910, 900])
    assert norms.hit_rate_apart(LASERS * FIRINGS, 1.5) > norms.hit_rate_limit


def test_scans_that_differ_among_themselves_allow_as_much():
    assert _norms([900, 500]).hit_rate_limit == pytest.approx(0.4)


def test_one_intensity_for_all_is_beyond_the_limit():
    norms = _norms([900, 905, 910, 900])
    assert norms.intensities_apart(np.full(900, 0.5), 1.5) > norms.intensity_limit
    assert norms.intensities_apart(np.random.default_rng(5).uniform(size=900), 1.5) < norms.intensity_limit


def test_limits_never_vanish():
    norms = _norms([1000, 1000], np.zeros(2000))
    assert norms.hit_rate_limit == norms.intensity_limit == 0.01
