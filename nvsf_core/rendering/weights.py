"""Alpha compositing in log space: how much each sample of a ray is seen, and where half of it is."""

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

    Args:
        optical_depth: (rays, samples) floating, at least 0, front to back; infinity = opaque, 0 = no
            sample. NaN gives NaN.

    Returns:
        weights (rays, samples) in [0, 1], transmittance_after (rays,) in [0, 1].

    Raises:
        ShapeError: not two axes.
        DivergedError: a depth is negative.
    """
    if optical_depth.ndim != 2:
        raise ShapeError(
            f"weights_from_optical_depth: expected (rays, samples), found {tuple(optical_depth.shape)}"
        )
    if bool((optical_depth < 0.0).any()):
        raise DivergedError(
            f"weights_from_optical_depth: expected depths of at least 0, found {optical_depth.min().item()}; "
            "densities and lengths of samples are never negative: look at what makes them"
        )
    # The exclusive sum is shifted rather than subtracted, which would cancel.
    depth_before = torch.cumsum(functional.pad(optical_depth, (1, 0)), dim=-1)[:, :-1]
    weights = torch.exp(-depth_before) * -torch.expm1(-optical_depth)
    return weights, torch.exp(-optical_depth.sum(dim=-1))


def weighted_median_index(weights: Tensor) -> Tensor:
    """Index of a ray's weighted median sample: the smallest i with ``sum up to i >= half of the total``.

    On a ray that meets an edge the mean lies in the air between both surfaces; the median lies on one.
    A ray of total weight 0 gives index 0.

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
