"""Compositing of rays with differing numbers of surfaces, and its adjoint, on CUDA, compiled by Triton.

The same sums as in `composite`, in double precision too; a program has a block of rays and walks along all of
them at once. The interpreter is as in `encodings.hash_grid_triton`.
"""

# Triton types its functions by their arguments at launch, and gives annotations a meaning of its own.
# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nvsf_core.kernels import composite
from nvsf_core.kernels.encodings.hash_grid_triton import add

_BLOCK = 64
_MEANS = tl.constexpr(composite.N_MEANS)
_UNIT_M = tl.constexpr(composite.RANGE_UNIT_M)
_LEAST_TOTAL = tl.constexpr(composite.LEAST_TOTAL)
_OWN_SHARE = tl.constexpr(composite.OWN_PRIOR_SHARE)
_COSINE, _BRIGHTNESS = tl.constexpr(1), tl.constexpr(4)


@triton.jit
def _seen_and_left(logit):
    """Opacity and 1 - opacity; neither is rounded away."""
    small = tl.exp(-tl.abs(logit))
    large = 1.0 / (1.0 + small)
    small = small * large
    return tl.where(logit >= 0.0, large, small), tl.where(logit >= 0.0, small, large)


@triton.jit
def _larger(a, b):
    return tl.maximum(a, b)


@triton.jit
def _rays(first, rays, BLOCK: tl.constexpr):
    """Numbers of a program's rays, whether they exist, their first surfaces and numbers of surfaces."""
    ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = ray < rays
    begin = tl.load(first + ray, mask=inside, other=0)
    count = tl.load(first + ray + 1, mask=inside, other=0) - begin
    return ray, inside, begin, count


@triton.jit
def _double(pointer, at, there):
    return tl.load(pointer + at, mask=there, other=0.0).to(tl.float64)


@triton.jit(do_not_specialize=["rays"])
def _forward(
    first, logit, range_m, features, facts, surface_hit_prior, hit_prior, weights, summary, median, asked,
    is_own, rays, FEATURES: tl.constexpr, WIDTH: tl.constexpr,
    FACTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    ray, inside, begin, count = _rays(first, rays, BLOCK)
    most = tl.reduce(count, 0, _larger)
    feature = tl.arange(0, WIDTH)[None, :]
    nothing = tl.full((BLOCK,), 0.0, tl.float64)
    light = nothing + 1.0
    total, distance, cosine, brightness, moving, own_prior = (
        nothing, nothing, nothing, nothing, nothing, nothing,
    )  # fmt: skip
    mixed = tl.full((BLOCK, WIDTH), 0.0, tl.float32)
    for i in range(0, most):
        there, at = i < count, begin + i
        seen, left = _seen_and_left(_double(logit, at, there))
        weight = tl.where(there, light * seen, 0.0)
        light = tl.where(there, light * left, light)
        tl.store(weights + at, weight.to(tl.float32), mask=there)
        total += weight
        distance += weight * _double(range_m, at, there)
        cosine += weight * _double(facts, at * FACTS + _COSINE, there)
        brightness += weight * _double(facts, at * FACTS + _BRIGHTNESS, there)
        own = tl.load(surface_hit_prior + at, mask=there, other=-1.0)
        moving += tl.where(own >= 0.0, weight, 0.0)
        own_prior += tl.where(own >= 0.0, weight * own, 0.0)
        shown = there[:, None] & (feature < FEATURES)
        value = tl.load(features + at[:, None] * FEATURES + feature, mask=shown, other=0.0)
        mixed += weight.to(tl.float32)[:, None] * value
    divisor = tl.where(total < _LEAST_TOTAL, _LEAST_TOTAL, total)
    columns = FEATURES + _MEANS
    row = summary + ray * columns
    target = row[:, None] + feature
    tl.store(target, mixed, mask=inside[:, None] & (feature < FEATURES))
    tl.store(row + FEATURES, total.to(tl.float32), mask=inside)
    tl.store(row + FEATURES + 1, (distance / divisor / _UNIT_M).to(tl.float32), mask=inside)
    tl.store(row + FEATURES + 2, (cosine / divisor).to(tl.float32), mask=inside)
    tl.store(row + FEATURES + 3, (brightness / divisor).to(tl.float32), mask=inside)
    owns = (moving > 0.0) & (moving >= _OWN_SHARE * total)
    given = tl.load(hit_prior + ray, mask=inside, other=0.0)
    mean = own_prior / tl.where(owns, moving, 1.0)
    tl.store(is_own + ray, owns, mask=inside)
    tl.store(asked + ray, tl.where(owns, mean.to(tl.float32), given), mask=inside)
    half = 0.5 * tl.where(owns, moving, total)
    so_far, reached, where = nothing, begin - begin, begin
    light = nothing + 1.0
    for i in range(0, most):
        # Weights once more: another thread of the program may have stored them.
        there, at = i < count, begin + i
        seen, left = _seen_and_left(_double(logit, at, there))
        weight = (light * seen).to(tl.float32).to(tl.float64)
        light = tl.where(there, light * left, light)
        own = tl.load(surface_hit_prior + at, mask=there, other=-1.0)
        counts = there & ((own >= 0.0) | (owns == 0))
        so_far += tl.where(counts, weight, 0.0)
        ends = counts & (reached == 0) & (so_far >= half)
        where = tl.where(ends, at, where)
        reached = tl.where(ends, 1, reached)
    tl.store(median + ray, where, mask=inside)


@triton.jit(do_not_specialize=["rays"])
def _adjoint(
    first, logit, range_m, features, facts, weights, summary, grad_weights, grad_summary, grad_logit,
    grad_range, grad_features, rays, FEATURES: tl.constexpr, WIDTH: tl.constexpr,
    FACTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    ray, inside, begin, count = _rays(first, rays, BLOCK)
    most = tl.reduce(count, 0, _larger)
    feature = tl.arange(0, WIDTH)[None, :]
    row = ray * (FEATURES + _MEANS)
    total = _double(summary, row + FEATURES, inside)
    divisor = tl.where(total < _LEAST_TOTAL, _LEAST_TOTAL, total)
    # Below the least total the divisor is constant, and the means' own share of it has no gradient.
    pull = tl.where(total > _LEAST_TOTAL, 1.0, 0.0).to(tl.float64)
    by_total = _double(grad_summary, row + FEATURES, inside)
    by_range = _double(grad_summary, row + FEATURES + 1, inside) / divisor
    by_cosine = _double(grad_summary, row + FEATURES + 2, inside) / divisor
    by_brightness = _double(grad_summary, row + FEATURES + 3, inside) / divisor
    mean_range = pull * _double(summary, row + FEATURES + 1, inside)
    mean_cosine = pull * _double(summary, row + FEATURES + 2, inside)
    mean_brightness = pull * _double(summary, row + FEATURES + 3, inside)
    wanted = inside[:, None] & (feature < FEATURES)
    by_feature = tl.load(grad_summary + row[:, None] + feature, mask=wanted, other=0.0)
    behind = tl.full((BLOCK,), 0.0, tl.float64)
    for back in range(0, most):
        i = most - 1 - back
        there, at = i < count, begin + i
        weight = _double(weights, at, there)
        by_weight = _double(grad_weights, at, there) + by_total
        by_weight += by_range * (_double(range_m, at, there) / _UNIT_M - mean_range)
        by_weight += by_cosine * (_double(facts, at * FACTS + _COSINE, there) - mean_cosine)
        by_weight += by_brightness * (_double(facts, at * FACTS + _BRIGHTNESS, there) - mean_brightness)
        shown = there[:, None] & (feature < FEATURES)
        place = at[:, None] * FEATURES + feature
        value = tl.load(features + place, mask=shown, other=0.0)
        by_weight += tl.reduce((by_feature * value).to(tl.float64), 1, add)
        tl.store(grad_features + place, weight.to(tl.float32)[:, None] * by_feature, mask=shown)
        seen, left = _seen_and_left(_double(logit, at, there))
        by_logit = weight * left * by_weight - seen * behind
        tl.store(grad_logit + at, by_logit.to(tl.float32), mask=there)
        tl.store(grad_range + at, (by_range * weight / _UNIT_M).to(tl.float32), mask=there)
        behind += tl.where(there, weight * by_weight, 0.0)


def forward(
    first: Tensor, logit: Tensor, range_m: Tensor, features: Tensor, facts: Tensor, surface_hit_prior: Tensor,
    hit_prior: Tensor,
) -> tuple[Tensor, ...]:  # fmt: skip
    """What `composite_rays` gives, without autograd, of its arguments on the device.

    Args:
        first: (n + 1,) int64.
        logit: (m,) float32.
        range_m: (m,) float32, metres.
        features: (m, d) float32.
        facts: (m, 6) float32.
        surface_hit_prior: (m,) float32.
        hit_prior: (n,) float32.
    """
    rays, device = len(hit_prior), logit.device
    found = (
        torch.empty_like(logit),
        torch.empty(rays, features.shape[1] + composite.N_MEANS, dtype=torch.float32, device=device),
        torch.empty(rays, dtype=torch.int64, device=device),
        torch.empty(rays, dtype=torch.float32, device=device),
        torch.empty(rays, dtype=torch.bool, device=device),
    )
    given = (first, logit, range_m, features, facts, surface_hit_prior, hit_prior)
    _launch(_forward, given, found, rays)
    return found


# Wide: columns of the same rays and surfaces, and the gradients by them.
def adjoint(
    first: Tensor, logit: Tensor, range_m: Tensor, features: Tensor, facts: Tensor, weights: Tensor,
    summary: Tensor, grad_weights: Tensor, grad_summary: Tensor,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Gradients of logit (m,), range (m,) and features (m, d) from those of weights and summary.

    Args:
        first: (n + 1,) int64.
        logit: (m,) float32.
        range_m: (m,) float32, metres.
        features: (m, d) float32.
        facts: (m, 6) float32.
        weights: (m,) float32 as of `forward`.
        summary: (n, d + 4) float32 as of `forward`.
        grad_weights: (m,) float32.
        grad_summary: (n, d + 4) float32.
    """
    # Row by row, as the kernel writes, whatever the strides of what was given.
    found = tuple(
        torch.empty_like(one, memory_format=torch.contiguous_format) for one in (logit, range_m, features)
    )
    given = (first, logit, range_m, features, facts, weights, summary, grad_weights, grad_summary)
    _launch(_adjoint, given, found, len(summary))
    return found


def _launch(kernel: Any, given: tuple[Tensor, ...], found: tuple[Tensor, ...], rays: int) -> None:
    """Run a kernel over all rays; features are the fourth tensor given, facts the fifth."""
    if rays == 0:
        return
    width, facts = given[3].shape[1], given[4].shape[1]
    # Triton launches on the current device, which need not be the tensors'.
    with torch.cuda.device_of(given[1]):  # type: ignore[no-untyped-call]
        kernel[(triton.cdiv(rays, _BLOCK),)](
            *(tensor.detach().contiguous() for tensor in given), *found, rays, FEATURES=width,
            WIDTH=triton.next_power_of_2(width), FACTS=facts, BLOCK=_BLOCK, enable_fp_fusion=False,
        )  # fmt: skip
