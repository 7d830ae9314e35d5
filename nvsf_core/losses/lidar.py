"""Losses of LiDAR rays: range, hit probability and intensity."""

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

CLAMP_M = 3.0
"""Largest error of a range that counts: a surface behind an edge must not outweigh all others."""


def depth_loss(weights: Tensor, range_m: Tensor, true_range_m: Tensor) -> Tensor:
    """Weighted range error of returns, metres (r,): sum_k w_k min(|t_k - t|, 3) + 3 (1 - sum_k w_k).

    Weights (r, k), of a sum of at most 1, and ranges (r, k) are of a ray's surfaces; t (r,) is recorded.
    """
    error = (range_m - true_range_m[:, None]).abs().clamp_max(CLAMP_M)
    missing = 1.0 - weights.sum(dim=1)
    return torch.as_tensor((weights * error).sum(dim=1) + CLAMP_M * missing)


def absolute_range_error(rendered_range: Tensor, true_range: Tensor) -> Tensor:
    """|D^ - D| (r,), in the unit of both; 0 for dropped rays. Eq. 6 of the paper (L_depth), to be summed.

    The rendered range (r,) of a dropped ray, recorded as 0, is multiplied by 0, as in the authors' code:
    drops are learned by the hit probability. Scaled units in the `paper` recipe.
    """
    return (rendered_range * (true_range > 0) - true_range).abs()


SPREAD_M = 0.2
"""Distance from the return at which a surface's likelihood is 1 / e: the roughness of objects' surfels."""
_OUTLIER = 0.01
"""Likelihood of a return that is near no surface: such a return has almost no gradient."""


def surface_likelihood(weights: Tensor, range_m: Tensor, true_range_m: Tensor) -> Tensor:
    """Negative log-likelihood of returns, nats (r,): -log(sum_k w_k exp(-|t_k - t| / 0.2 m) + 0.01).

    Its minimum is where each weight is the share of rays that end on that surface. The minimum of
    `depth_loss` gives the likeliest surface all weight, so that thin objects, which most rays pass, vanish.
    Arguments as of `depth_loss`.
    """
    near = torch.exp(-(range_m - true_range_m[:, None]).abs() / SPREAD_M)
    return -torch.log((weights * near).sum(dim=1) + _OUTLIER)


def raydrop_loss(hit_logit: Tensor, is_return: Tensor) -> Tensor:
    """Cross-entropy (r,), nats, of hit logits (r,) with whether each ray returned (r,), 0 or 1."""
    return binary_cross_entropy_with_logits(hit_logit, is_return, reduction="none")


def squared_hit_error(hit: Tensor, is_return: Tensor) -> Tensor:
    """(P^ - P)^2 (r,) of hit probabilities (r,), 0..1. Eq. 8 of the paper (L_raydrop), to be summed."""
    return (hit - is_return.to(hit)) ** 2


def intensity_loss(intensity_logit: Tensor, true_intensity: Tensor) -> Tensor:
    """Squared error (r,) of intensities, from logits (r,) and recorded intensities (r,) in 0..1."""
    return (torch.sigmoid(intensity_logit) - true_intensity) ** 2


def squared_intensity_error(intensity: Tensor, true_intensity: Tensor, is_return: Tensor) -> Tensor:
    """(I^ - I)^2 (r,) in 0..1, 0 for dropped rays. Eq. 7 of the paper (L_intensity), to be summed."""
    return ((intensity - true_intensity) * is_return) ** 2
