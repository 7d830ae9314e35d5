"""Alpha compositing in log space: weights of a ray's samples, and a ray's value from them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.numerics import require_finite


def weights_from_optical_depth(optical_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the samples of each ray from their optical depths tau = density * length.

    ``w_i = exp(-sum of tau_j over j < i) * (1 - exp(-tau_i))``, and the transmittance behind all samples,
    ``exp(-sum of all tau_j)``; together they sum to 1. Logarithms are summed instead of a product of numbers
    near 1, and 1 - exp is expm1, so thin samples keep their weight and their gradient.

    Half types are summed in float32 and rounded at the end.

    Args:
        optical_depth: (rays, samples) floating, at least 0, front to back; infinity = opaque, 0 = no sample.
            NaN gives NaN.

    Returns:
        weights (rays, samples) in [0, 1], transmittance_after (rays,) in [0, 1].

    Raises:
        ShapeError: not two axes.
        DivergedError: a depth is negative.
    """
    _require_rays_and_samples(optical_depth, "weights_from_optical_depth")
    if bool((optical_depth < 0.0).any()):
        raise DivergedError(
            f"weights_from_optical_depth: expected depths of at least 0, found {optical_depth.min().item()}; "
            "densities and lengths of samples are never negative: look at what makes them"
        )
    depth = _accumulating(optical_depth)
    weights = torch.exp(-_sum_before(depth)) * -torch.expm1(-depth)
    return weights.to(optical_depth.dtype), torch.exp(-depth.sum(dim=-1)).to(optical_depth.dtype)


def weights_from_opacity_logits(logits: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the samples of each ray from their opacities alpha = sigmoid(logit).

    ``w_i = exp(log alpha_i + sum of log(1 - alpha_j) over j < i)`` with ``log(1 - alpha) = -softplus(logit)``
    and ``log(alpha) = -softplus(-logit)``, so that nearly transparent and nearly opaque samples are exact.

    Args:
        logits: (rays, samples) floating, front to back; -inf = no sample.

    Returns:
        weights (rays, samples) in [0, 1], transmittance_after (rays,) in [0, 1].

    Raises:
        ShapeError: not two axes.
    """
    _require_rays_and_samples(logits, "weights_from_opacity_logits")
    wide = _accumulating(logits)
    optical_depth = -functional.logsigmoid(-wide)
    weights = torch.exp(functional.logsigmoid(wide) - _sum_before(optical_depth))
    return weights.to(logits.dtype), torch.exp(-optical_depth.sum(dim=-1)).to(logits.dtype)


def _accumulating(tensor: Tensor) -> Tensor:
    """Half types as float32, so that a thousand terms can be summed."""
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor


def _sum_before(optical_depth: Tensor) -> Tensor:
    """Exclusive cumulative sum along a ray; by a shift, as a subtraction would cancel."""
    return torch.cumsum(functional.pad(optical_depth, (1, 0)), dim=-1)[:, :-1]


def _require_rays_and_samples(tensor: Tensor, function: str) -> None:
    if tensor.ndim != 2:
        raise ShapeError(f"{function}: expected (rays, samples), found {tuple(tensor.shape)}")


def expected_value(weights: Tensor, values: Tensor) -> Tensor:
    """Weighted sum of samples, ``sum of w_i * v_i``; not divided by the sum of the weights.

    Args:
        weights: (rays, samples).
        values: (rays, samples) or (rays, samples, channels).

    Returns:
        (rays,) or (rays, channels).

    Raises:
        ShapeError: the rays or samples differ.
    """
    if weights.ndim != 2 or values.ndim not in (2, 3) or values.shape[:2] != weights.shape:
        raise ShapeError(
            "expected_value: expected weights (rays, samples) and values (rays, samples[, channels]), found "
            f"{tuple(weights.shape)} and {tuple(values.shape)}"
        )
    if values.ndim == 2:
        return (weights * values).sum(dim=-1)
    return torch.einsum("rs,rsc->rc", weights, values)


def weighted_median_index(weights: Tensor) -> Tensor:
    """Index of a ray's weighted median sample: the smallest i with ``sum up to i >= half of the total``.

    On a ray that meets an edge the mean lies in the air between both surfaces; the median lies on one.
    A ray of total weight 0 gives index 0. Half types are summed in float32.

    Args:
        weights: (rays, samples), at least 0, at least one sample.

    Returns:
        (rays,) int64 sample indices.

    Raises:
        ShapeError: not two axes, or no sample.
        DivergedError: a weight is NaN, infinite or negative.
    """
    if weights.ndim != 2 or weights.shape[1] == 0:
        raise ShapeError(
            f"weighted_median_index: expected (rays, samples >= 1), found {tuple(weights.shape)}"
        )
    weights = weights.detach()
    if weights.dtype in (torch.float16, torch.bfloat16):
        weights = weights.float()
    cumulative = torch.cumsum(weights, dim=-1)
    if bool((weights < 0.0).any()):
        raise DivergedError(
            f"weighted_median_index: expected weights of at least 0, found {weights.min().item()}; "
            "look at what makes them"
        )
    half = 0.5 * require_finite("weighted_median_index: sum of the weights", cumulative[:, -1:])
    return (cumulative < half).sum(dim=-1)


def value_at(values: Tensor, index: Tensor) -> Tensor:
    """The value of one sample of each ray.

    Args:
        values: (rays, samples).
        index: (rays,) int64, each in [0, samples).

    Returns:
        (rays,).
    """
    return values.gather(1, index[:, None]).squeeze(1)
