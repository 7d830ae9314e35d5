"""Laws of compositing rays with differing numbers of surfaces, against torch's own operations."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from nvsf_core.kernels.composite import OWN_PRIOR_SHARE, composite_rays

COUNTS = np.array([0, 1, 5, 24, 3, 0, 2, 12] * 40)
RAYS, SURFACES = len(COUNTS), int(COUNTS.sum())


def some_surfaces() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Logits with a few extremes, ranges, features and facts of all rays' surfaces."""
    generator = torch.Generator().manual_seed(0)
    logit = 3.0 * torch.randn(SURFACES, generator=generator)
    logit[:6] = torch.tensor([-90.0, 90.0, -30.0, 30.0, -30.0, 90.0])
    range_m = 1.0 + 60.0 * torch.rand(SURFACES, generator=generator)
    features = torch.randn(SURFACES, 8, generator=generator)
    return logit, range_m, features, torch.rand(SURFACES, 6, generator=generator)


def mask() -> Tensor:
    return torch.arange(24) < torch.from_numpy(COUNTS)[:, None]


def padded(values: Tensor) -> Tensor:
    full = values.new_zeros(RAYS, 24, *values.shape[1:])
    full[mask()] = values
    return full


def by_torch(logit: Tensor, range_m: Tensor, features: Tensor, facts: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and summaries by padding and by torch's operations."""
    empty = torch.where(mask(), padded(logit), -torch.inf)
    before = torch.cumsum(pad(logsigmoid(-empty), (1, 0)), dim=1)[:, :-1]
    weights = torch.exp(logsigmoid(empty) + before)
    total = weights.sum(dim=1)
    share = weights / total.clamp_min(torch.finfo(weights.dtype).eps)[:, None]
    means = [padded(range_m) / 50.0, padded(facts)[..., 1], padded(facts)[..., 4]]
    summary = torch.cat(
        [
            (weights[..., None] * padded(features)).sum(dim=1),
            total[:, None],
            *((share * mean).sum(dim=1, keepdim=True) for mean in means),
        ],
        dim=1,
    )
    return weights[mask()], summary


def composited(*surfaces: Tensor, surface_hit_prior: Tensor | None = None) -> tuple[Tensor, ...]:
    first = torch.from_numpy(np.concatenate([[0], np.cumsum(COUNTS)]))
    own = torch.full((SURFACES,), -1.0) if surface_hit_prior is None else surface_hit_prior
    return composite_rays(*surfaces, first, own, torch.full((RAYS,), 0.25))


def test_weights_and_summaries_are_those_of_torch() -> None:
    surfaces = some_surfaces()
    weights, summary, _, hit_priors, on_own = composited(*surfaces)
    expected_weights, expected = by_torch(*surfaces)
    assert torch.allclose(weights, expected_weights, atol=1e-7, rtol=1e-5)
    assert torch.allclose(summary, expected, atol=1e-5, rtol=1e-5)
    assert (hit_priors == 0.25).all() and not on_own.any()


def test_gradients_are_those_of_torch_in_double_precision() -> None:
    logit, range_m, features, facts = some_surfaces()
    logit = logit.clamp(-8.0, 8.0)  # below, a ray's mean is a ratio of two roundings
    generator = torch.Generator().manual_seed(1)
    pulls = torch.randn(SURFACES, generator=generator), torch.randn(RAYS, 12, generator=generator)

    def gradients(dtype: torch.dtype) -> list[Tensor]:
        leaves = [one.detach().to(dtype, copy=True).requires_grad_() for one in (logit, range_m, features)]
        given = (*leaves, facts.to(dtype))
        weights, summary = composited(*given)[:2] if dtype == torch.float32 else by_torch(*given)
        ((weights * pulls[0]).sum() + (summary * pulls[1]).sum()).backward()
        return [leaf.grad.double() for leaf in leaves]

    for ours, theirs in zip(gradients(torch.float32), gradients(torch.float64), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-5, rtol=1e-4)


def test_the_median_is_the_first_surface_with_half_of_the_weight() -> None:
    surfaces = some_surfaces()
    weights, _, median, *_ = composited(*surfaces)
    begin = 0
    for ray, count in enumerate(COUNTS):
        so_far = np.cumsum(weights[begin : begin + count].numpy().astype(np.float64))
        chosen = int(median[ray]) - begin
        if count:
            assert so_far[chosen] >= 0.5 * so_far[-1] - 1e-7
            assert chosen == 0 or so_far[chosen - 1] < 0.5 * so_far[-1] + 1e-7
        begin += int(count)


def test_only_rays_that_end_on_what_moves_ask_it() -> None:
    surfaces = some_surfaces()
    own = torch.where(torch.rand(SURFACES, generator=torch.Generator().manual_seed(2)) < 0.5, 0.75, -1.0)
    weights, _, _, hit_priors, is_own = composited(*surfaces, surface_hit_prior=own)
    on_own = padded(weights * (own >= 0)).sum(dim=1)
    moving = (on_own > 0.0) & (on_own >= OWN_PRIOR_SHARE * padded(weights).sum(dim=1))
    assert 20 < moving.sum() < RAYS - 20
    assert torch.allclose(hit_priors, torch.where(moving, 0.75, 0.25)) and torch.equal(is_own, moving)


def test_a_hidden_surface_has_no_gradient_and_none_is_infinite() -> None:
    logit, range_m, features, facts = some_surfaces()
    logit = torch.full_like(logit, 80.0).requires_grad_()
    weights, summary, *_ = composited(logit, range_m, features, facts)
    (weights.sum() + summary.sum()).backward()
    assert logit.grad is not None and torch.isfinite(logit.grad).all()
    assert logit.grad.abs().max() < 1e-20


def test_a_ray_ends_on_what_moves_where_that_has_a_fifth_of_its_weight() -> None:
    surfaces = some_surfaces()
    is_own = torch.rand(SURFACES, generator=torch.Generator().manual_seed(3)) < 0.3
    _, _, likeliest, *_ = composited(*surfaces)
    weights, _, median, *_ = composited(*surfaces, surface_hit_prior=torch.where(is_own, 0.75, -1.0))
    begin, decided = 0, 0
    for ray, count in enumerate(COUNTS):
        part = slice(begin, begin + int(count))
        own = np.where(is_own[part].numpy(), weights[part].numpy().astype(np.float64), 0.0)
        begin += int(count)
        share = own.sum() / max(float(weights[part].sum()), 1e-30)
        if share < OWN_PRIOR_SHARE - 1e-6:
            assert median[ray] == likeliest[ray]
        elif share > OWN_PRIOR_SHARE + 1e-6:
            chosen = int(median[ray]) - part.start
            assert own[chosen] > 0.0
            assert own[: chosen + 1].sum() >= 0.5 * own.sum() - 1e-7
            assert own[:chosen].sum() < 0.5 * own.sum() + 1e-7
            decided += int(median[ray] != likeliest[ray])
    assert decided > 10
