"""Laws of the drop votes."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.evidence.drop_prior import build_drop_prior


def three_scans():
    """Two lasers, four firings, three scans; laser 1 never returns at firing 2."""
    lasers, firings, fractions, lengths = [], [], [], []
    for _ in range(3):
        cells = [(row, f) for row in range(2) for f in range(4) if (row, f) != (1, 2)]
        lasers += [row for row, _ in cells]
        firings += [f for _, f in cells]
        fractions += [(f + 0.5) / 4 - 0.5 for _, f in cells]
        lengths.append(len(cells))
    return build_drop_prior(
        np.array(lasers), np.array(firings), np.array(fractions), np.concatenate([[0], np.cumsum(lengths)]),
        np.array([4, 4, 4]), np.array([0.0, 0.1, 0.2]), lasers=2, nominal_firings=4,
    )  # fmt: skip


@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_firings_that_agree_in_all_scans_have_a_phase(phase) -> None:
    prior = three_scans()
    assert prior.firing_phase() == pytest.approx(0.5)
    moved = replace(prior, fraction=prior.fraction + np.float32((phase - 0.5) / 4))
    assert moved.firing_phase() == pytest.approx(phase, abs=1e-6)
    turned = moved.fraction + np.linspace(0.0, 0.25, 3, dtype=np.float32)[:, None]
    assert replace(prior, fraction=turned).firing_phase() == 0.5


def test_a_beam_that_never_returned_gets_no_vote() -> None:
    prior = three_scans()
    hit_prior = prior.hit_prior(
        np.array([1, 1, 0]), np.array([0.125, -0.125, 0.125]), prior.nearest_scans(0.05, 3)
    )
    assert hit_prior.tolist() == [0.0, 1.0, 1.0]


def test_a_whole_turn_votes_as_its_rays_do() -> None:
    prior = three_scans()
    prior.is_hit[0, 0, 3] = False
    lasers, fraction = np.array([1, 0, 1]), np.linspace(-0.5, 0.5, 9)
    scans = prior.nearest_scans(0.05, 2)
    turn = prior.hit_prior_of_sweep(lasers, fraction, scans)
    rays = prior.hit_prior(np.repeat(lasers, 9), np.tile(fraction, 3), scans)
    assert turn.shape == (3, 9) and np.array_equal(turn.ravel(), rays) and len(np.unique(turn)) == 3


def test_a_scan_never_votes_on_itself() -> None:
    prior = three_scans()
    assert 1 not in prior.nearest_scans(0.1, 2, leave_out_s=0.1)


def test_one_scan_alone_cannot_be_left_out() -> None:
    prior = three_scans()
    single = type(prior)(prior.time_s[:1], prior.fraction[:1], prior.is_hit[:1])
    with pytest.raises(DataError, match="another training scan"):
        single.nearest_scans(0.0, 6, leave_out_s=0.0)


def test_a_scan_of_which_no_laser_is_known_is_never_asked() -> None:
    prior = three_scans()
    prior.is_hit[1] = False
    assert prior.is_unidentified.tolist() == [False, True, False]
    assert prior.nearest_scans(0.11, 3).tolist() == [2, 0]
    assert prior.nearest_scans(0.11, 1).tolist() == [2], "another one is asked in its place"
    assert prior.nearest_scans(0.0, 3, leave_out_s=0.0).tolist() == [2]


def test_silent_scans_are_asked_where_no_other_is_left() -> None:
    prior = three_scans()
    prior.is_hit[:2] = False
    assert prior.nearest_scans(0.2, 3, leave_out_s=0.2).tolist() == [1, 0]
    prior.is_hit[:] = False
    assert not prior.is_unidentified.any(), "beside none that speaks none is silent"
    assert prior.nearest_scans(0.0, 3).tolist() == [0, 1, 2]


def test_unknown_firings_are_laid_on_nominal_ones_by_time() -> None:
    prior = build_drop_prior(
        np.array([0, 0]), np.array([-1, -1]), np.array([-0.45, 0.45]), np.array([0, 2]), np.array([0]),
        np.array([0.0]), lasers=1, nominal_firings=10,
    )  # fmt: skip
    assert prior.is_hit[0, 0].tolist() == [True] + [False] * 8 + [True]
