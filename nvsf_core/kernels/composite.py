"""Compositing of rays with differing numbers of surfaces, and its adjoint: in numba, on CUDA by Triton.

Without Triton, tensors of another device are copied to the CPU, and the results back to that device.

Of a ray's surfaces i, front to back, with a = sigmoid(logit): w_i = a_i prod_{j<i} (1 - a_j). A ray's
summary is (sum w f, W, sum w t / W / 50, sum w c / W, sum w b / W) with features f (d), W = sum w, range t,
cosine c and brightness b; W is at least 1.2e-7 where it divides. A ray's sums belong to one thread.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from nvsf_core.kernels.encodings.backend import Backend, choose_backend
from nvsf_core.kernels.voxel_march import RAYS_A_TASK

RANGE_UNIT_M = 50.0
N_MEANS = 4
_COSINE, _BRIGHTNESS = 1, 4
LEAST_TOTAL = float(np.finfo(np.float32).eps)
OWN_PRIOR_SHARE = 0.3
"""Share of a ray's weight from which surfaces with a hit prior of their own (moving objects) decide its end.
By the likeliest end alone a wheel that most rays pass by would vanish from the scan."""


@njit(inline="always")
def _seen_and_left(logit):  # type: ignore[no-untyped-def]
    """Opacity and 1 - opacity; neither is rounded away."""
    if logit >= 0.0:
        small = np.exp(-logit)
        return 1.0 / (1.0 + small), small / (1.0 + small)
    small = np.exp(logit)
    return small / (1.0 + small), 1.0 / (1.0 + small)


@njit(parallel=True, cache=True, nogil=True)
def _forward(first, logit, range_m, features, facts, surface_hit_prior, hit_prior):  # type: ignore[no-untyped-def]
    n, width = len(first) - 1, features.shape[1]
    weights = np.empty(len(logit), np.float32)
    summary = np.zeros((n, width + N_MEANS), np.float32)
    median = np.zeros(n, np.int64)
    asked, is_own = np.empty(n, np.float32), np.empty(n, np.bool_)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            light = 1.0
            total, distance, cosine, brightness, moving, own_prior = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(first[ray], first[ray + 1]):
                seen, left = _seen_and_left(float(logit[i]))
                weight = light * seen
                light *= left
                weights[i] = weight
                total += weight
                distance += weight * range_m[i]
                cosine += weight * facts[i, _COSINE]
                brightness += weight * facts[i, _BRIGHTNESS]
                if surface_hit_prior[i] >= 0.0:
                    moving += weight
                    own_prior += weight * surface_hit_prior[i]
                for c in range(width):
                    summary[ray, c] += np.float32(weight) * features[i, c]
            divisor = max(total, LEAST_TOTAL)
            summary[ray, width] = total
            summary[ray, width + 1] = distance / divisor / RANGE_UNIT_M
            summary[ray, width + 2] = cosine / divisor
            summary[ray, width + 3] = brightness / divisor
            own = moving > 0.0 and moving >= OWN_PRIOR_SHARE * total
            is_own[ray], asked[ray] = own, own_prior / moving if own else hit_prior[ray]
            half, so_far = 0.5 * (moving if own else total), 0.0
            median[ray] = first[ray]
            for i in range(first[ray], first[ray + 1]):
                if own and surface_hit_prior[i] < 0.0:
                    continue
                so_far += weights[i]
                if so_far >= half:
                    median[ray] = i
                    break
    return weights, summary, median, asked, is_own


@njit(parallel=True, cache=True, nogil=True)
def _adjoint(  # type: ignore[no-untyped-def]
    first, logit, range_m, features, facts, weights, summary, grad_weights, grad_summary
):
    n, width = len(first) - 1, features.shape[1]
    grad_logit = np.empty_like(logit)
    grad_range = np.empty_like(range_m)
    grad_features = np.empty_like(features)
    for task in prange((n + RAYS_A_TASK - 1) // RAYS_A_TASK):
        for ray in range(task * RAYS_A_TASK, min(n, (task + 1) * RAYS_A_TASK)):
            total = float(summary[ray, width])
            divisor = max(total, LEAST_TOTAL)
            # Below the least total the divisor is constant, and the means' own share of it has no gradient.
            pull = 1.0 if total > LEAST_TOTAL else 0.0
            by_range = grad_summary[ray, width + 1] / divisor
            by_cosine = grad_summary[ray, width + 2] / divisor
            by_brightness = grad_summary[ray, width + 3] / divisor
            behind = 0.0
            for i in range(first[ray + 1] - 1, first[ray] - 1, -1):
                by_weight = float(grad_weights[i]) + grad_summary[ray, width]
                by_weight += by_range * (range_m[i] / RANGE_UNIT_M - pull * summary[ray, width + 1])
                by_weight += by_cosine * (facts[i, _COSINE] - pull * summary[ray, width + 2])
                by_weight += by_brightness * (facts[i, _BRIGHTNESS] - pull * summary[ray, width + 3])
                for c in range(width):
                    by_weight += grad_summary[ray, c] * features[i, c]
                    grad_features[i, c] = weights[i] * grad_summary[ray, c]
                seen, left = _seen_and_left(float(logit[i]))
                grad_logit[i] = weights[i] * left * by_weight - seen * behind
                grad_range[i] = by_range * weights[i] / RANGE_UNIT_M
                behind += weights[i] * by_weight
    return grad_logit, grad_range, grad_features


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, logit: Tensor, range_m: Tensor, features: Tensor, facts: Tensor, first: Tensor,
        surface_hit_prior: Tensor, hit_prior: Tensor, backend: Backend,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        given = (first, logit, range_m, features, facts, surface_hit_prior, hit_prior)
        found = _triton().forward(*given) if backend == "triton" else _by_numba(_forward, *given)
        ctx.save_for_backward(first, logit, range_m, features, facts, *found[:2])
        ctx.backend = backend
        ctx.mark_non_differentiable(*found[2:])
        return found

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        given = (*ctx.saved_tensors, *grads[:2])
        found = _triton().adjoint(*given) if ctx.backend == "triton" else _by_numba(_adjoint, *given)
        return (*found, None, None, None, None, None)


def _by_numba(kernel: Callable[..., tuple[np.ndarray, ...]], *given: Tensor) -> tuple[Tensor, ...]:
    found = kernel(*(tensor.detach().cpu().contiguous().numpy() for tensor in given))
    return tuple(torch.from_numpy(array).to(given[0].device) for array in found)


def _triton() -> Any:
    """The kernels for CUDA, imported where they are used: not every machine has Triton."""
    from nvsf_core.kernels import composite_triton

    return composite_triton


# Wide: seven columns of the same rays and surfaces; the last is for tests.
def composite_rays(
    logit: Tensor, range_m: Tensor, features: Tensor, facts: Tensor, first: Tensor, surface_hit_prior: Tensor,
    hit_prior: Tensor, backend: Backend | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Weights, summaries and median surfaces of n rays with m surfaces in all; differentiable.

    Args:
        logit: (m,) float32 opacity logits.
        range_m: (m,) float32.
        features: (m, d) float32.
        facts: (m, 6) float32 as of `list_surfaces`; constant.
        first: (n + 1,) int64: where each ray's surfaces begin.
        surface_hit_prior: (m,) float32, negative where the surface has none of its own.
        hit_prior: (n,) float32.
        backend: Overrides the choice, "numba" or "triton"; the latter takes CPU tensors only under Triton's
            interpreter.

    Returns:
        weights (m,); summary (n, d + 4), see above; index (n,) int64 of the first surface with at least half
        of the ray's weight up to it (without surfaces, the ray's `first`), counting only surfaces with a hit
        prior of their own where these have at least `OWN_PRIOR_SHARE` of the weight; hit prior (n,): the
        mean of those surfaces where they decide where the ray ends, else `hit_prior`; and (n,) bool, whether
        they do.
    """
    return _Composite.apply(  # type: ignore[no-untyped-call]
        logit, range_m, features, facts, first, surface_hit_prior, hit_prior,
        backend or ("triton" if choose_backend(logit, features) == "triton" else "numba"),
    )  # fmt: skip
