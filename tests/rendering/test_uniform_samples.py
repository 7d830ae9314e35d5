"""Laws of the samples along a ray."""

import pytest
import torch

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.rendering.volume import uniform_samples

NEAR = torch.tensor([1.0, 0.0, 2.0])
FAR = torch.tensor([80.0, 1.0, 2.0])


def test_samples_without_jitter_are_even_and_reach_both_ends() -> None:
    t, delta = uniform_samples(NEAR, FAR, 5)
    assert torch.allclose(t[0], torch.tensor([1.0, 20.75, 40.5, 60.25, 80.0]))
    assert torch.allclose(delta[0], torch.tensor([19.75, 19.75, 19.75, 19.75, 79.0 / 5]))


def test_jitter_stays_within_the_limits_ascends_and_moves_by_half_a_step() -> None:
    generator = torch.Generator().manual_seed(0)
    for count in (2, 96, 768, 20_000):
        still, _ = uniform_samples(NEAR, FAR, count)
        t, delta = uniform_samples(NEAR, FAR, count, generator)
        assert (t >= NEAR[:, None]).all() and (t <= FAR[:, None]).all()
        assert (delta >= 0).all()
        assert ((t - still).abs() <= 0.501 * (FAR - NEAR)[:, None] / count + 1e-5).all()
    assert not torch.equal(t, uniform_samples(NEAR, FAR, count, generator)[0])


def test_the_same_generator_state_gives_the_same_samples() -> None:
    draws = [uniform_samples(NEAR, FAR, 96, torch.Generator().manual_seed(4))[0] for _ in range(2)]
    assert torch.equal(*draws)


def test_one_sample_and_no_ray_are_allowed() -> None:
    t, delta = uniform_samples(NEAR, FAR, 1)
    assert torch.equal(t[:, 0], NEAR) and torch.equal(delta[:, 0], FAR - NEAR)
    assert uniform_samples(NEAR[:0], FAR[:0], 7)[0].shape == (0, 7)


def test_a_ray_that_ends_before_it_begins_is_refused() -> None:
    with pytest.raises(DataError, match="ray 1"):
        uniform_samples(torch.tensor([0.0, 3.0]), torch.tensor([1.0, 2.0]), 4)
    with pytest.raises(DataError):
        uniform_samples(torch.tensor([0.0]), torch.tensor([torch.nan]), 4)
    with pytest.raises(ShapeError):
        uniform_samples(NEAR, FAR[:2], 4)
    with pytest.raises(ShapeError):
        uniform_samples(NEAR, FAR, 0)
