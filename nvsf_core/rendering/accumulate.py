"""Where along a ray its samples have given half of its weight."""

from __future__ import annotations

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.numerics import require_finite

__all__ = ["weighted_median_index"]


def weighted_median_index(weights: Tensor) -> Tensor:
    """Where the ray has given half of its weight: the smallest i with ``sum up to i >= half of the total``.

    On a ray that sees an edge the mean lies in the air between both surfaces; the median lies on one.
    A ray without any weight answers 0: ask its total before believing it.

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
    cumulative = torch.cumsum(weights, dim=-1)
    if bool((weights < 0.0).any()):
        raise DivergedError(
            f"weighted_median_index: expected weights of at least 0, found {weights.min().item()}; "
            "look at what makes them"
        )
    half = 0.5 * require_finite("weighted_median_index: sum of the weights", cumulative[:, -1:])
    return (cumulative < half).sum(dim=-1)
