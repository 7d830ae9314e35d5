"""Two answers to whether a ray returns are believed as far as left-out firings say."""

import numpy as np
import pytest
from scipy.special import expit

from nvsf_core.simulation.raydrop import EVEN, HitBlend, fit_blend, nats, rays_return


def two_answers(truth: HitBlend, n: int = 60_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logits of two answers, and returns drawn from a known blend of them."""
    rng = np.random.default_rng(0)
    network, ray_head = rng.normal(1.0, 2.0, (2, n)).astype(np.float32)
    return network, ray_head, rng.uniform(size=n) < expit(truth.logit(network, ray_head))


@pytest.mark.parametrize("weights", [(0.8, 0.2, 0.3), (0.3, 0.9, -0.5), (1.4, 0.0, 0.0)])
def test_the_blend_that_returns_were_drawn_from_is_found(weights: tuple[float, float, float]) -> None:
    truth = HitBlend(*weights)
    found = fit_blend(*two_answers(truth))
    assert found.network == pytest.approx(truth.network, abs=0.05)
    assert found.ray_head == pytest.approx(truth.ray_head, abs=0.05)
    assert found.offset == pytest.approx(truth.offset, abs=0.05)


def test_an_answer_that_says_the_contrary_is_not_asked() -> None:
    network, _, returned = two_answers(HitBlend(0.0, 1.0, 0.0))
    found = fit_blend(network, np.where(returned, -3.0, 3.0), returned)
    assert found.ray_head == 0.0 and abs(found.network) < 0.05


@pytest.mark.parametrize("all_return", [False, True])
def test_firings_that_leave_it_open_keep_the_start_or_stay_finite(all_return: bool) -> None:
    silent = fit_blend(np.zeros(10, np.float32), np.zeros(10, np.float32), np.arange(10) % 2 == 0)
    assert (silent.network, silent.ray_head) == (EVEN.network, EVEN.ray_head) and abs(silent.offset) < 1e-3
    sure = fit_blend(np.full(50, 8.0), np.full(50, -8.0), np.full(50, all_return))
    assert np.isfinite([sure.network, sure.ray_head, sure.offset]).all()
    assert (sure.logit(np.array(8.0), np.array(-8.0)) > 0.0) == all_return


def test_nats_are_the_mean_of_minus_log_probability() -> None:
    logit, returned = np.array([2.0, -1.0, 700.0]), np.array([True, True, True])
    assert nats(logit, returned) == pytest.approx(-np.log(expit(logit)).mean())
    assert nats(np.array([-1e4]), np.array([True])) == pytest.approx(1e4)


def test_a_ray_of_four_in_ten_returns_and_of_two_below_it_the_likelier_where_one_is_likely() -> None:
    hit = np.array([[0.4, 0.1, 0.39, 0.38, 0.3, 0.3, 0.2, 0.39, 0.28, 0.28, 0.39]], np.float32)
    expected = [[True, False, True, False, True, False, False, True, False, False, False]]
    assert rays_return(hit).tolist() == expected, "the last has no neighbour"
    assert rays_return(hit.astype(np.float64)[0]).tolist() == expected[0]
    assert not rays_return(np.full((2, 3), np.nan)).any()


def test_where_a_third_of_the_rays_return_the_pairs_of_a_scan_are_as_full_as_most_recorded_ones() -> None:
    """Chance decides each recorded ray by itself; a scan without any of these has only holes there."""
    hit = np.full((64, 2000), 1 / 3)
    recorded = (np.random.default_rng(0).random(hit.shape) < hit).reshape(64, -1, 2).any(-1)
    shown = rays_return(hit).reshape(64, -1, 2)
    assert shown.any(-1).all() and not shown.all(-1).any()
    assert 0.5 < recorded.mean() < 0.6
