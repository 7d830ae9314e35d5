"""One number a ray from the weights of its samples."""

from __future__ import annotations

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.numerics import require_finite

__all__ = ["expected_value", "value_at", "weighted_median_index"]


def expected_value(weights: Tensor, values: Tensor) -> Tensor:
    """``sum over samples of w_i * v_i``; not divided by the sum of the weights.

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
    """Where the ray has given half of its weight: the smallest i with ``sum up to i >= half of the total``.

    On a ray that sees an edge the mean lies in the air between both surfaces; the median lies on one.
    A ray without any weight answers 0: ask its total before believing it. Half types are summed in float32.

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
