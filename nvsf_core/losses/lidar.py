"""Losses of LiDAR rays: range, whether the ray returns, and intensity."""

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

CLAMP_M = 3.0
"""An error beyond this pulls no harder: what lies behind an edge is not wrong by its whole distance."""


def depth_loss(weights: Tensor, range_m: Tensor, true_range_m: Tensor) -> Tensor:
    """Metres (r,): sum_k w_k min(|t_k - t|, 3) + 3 (1 - sum_k w_k), of rays that returned.

    Args:
        weights: (r, k), rows sum to at most 1.
        range_m: (r, k) of the surfaces.
        true_range_m: (r,) recorded.
    """
    error = (range_m - true_range_m[:, None]).abs().clamp_max(CLAMP_M)
    missing = 1.0 - weights.sum(dim=1)
    return torch.as_tensor((weights * error).sum(dim=1) + CLAMP_M * missing)


def absolute_range_error(rendered_range: Tensor, true_range: Tensor) -> Tensor:
    """|D^ - D| (r,), in the unit of both, 0 where nothing returned; to be summed.

    The rendered range of a ray without return is multiplied by 0, as in the authors' code: whether it
    returns is the hit probability's to learn. Eq. 6 of the paper (L_depth).

    Args:
        rendered_range: (r,) expected range; scaled units in the `paper` recipe.
        true_range: (r,) recorded, 0 = no return.
    """
    return (rendered_range * (true_range > 0) - true_range).abs()


SPREAD_M = 0.2
"""Distance over which a surface's part in a return falls by e: an object's surfels are as rough."""
_OUTLIER = 0.01
"""Of a return that no proposed surface is near to: it pulls at nothing."""


def surface_likelihood(weights: Tensor, range_m: Tensor, true_range_m: Tensor) -> Tensor:
    """Nats (r,): -log(sum_k w_k exp(-|t_k - t| / 0.2 m) + 0.01), of rays that returned.

    Least where the weights are the shares of rays that end on each surface. The weighted distance
    (`depth_loss`) is least where the likeliest surface has all weight: it takes a thin thing that most of
    the rays beside it pass away altogether.

    Args:
        weights: (r, k), rows sum to at most 1.
        range_m: (r, k) of the surfaces.
        true_range_m: (r,) recorded.
    """
    near = torch.exp(-(range_m - true_range_m[:, None]).abs() / SPREAD_M)
    return -torch.log((weights * near).sum(dim=1) + _OUTLIER)


def raydrop_loss(hit_logit: Tensor, is_return: Tensor) -> Tensor:
    """Cross-entropy (r,) in nats between a hit logit (r,) and whether the ray returned (r,) 0 or 1."""
    return binary_cross_entropy_with_logits(hit_logit, is_return, reduction="none")


def squared_hit_error(hit: Tensor, is_return: Tensor) -> Tensor:
    """(P^ - P)^2 (r,) of the hit probability, all rays. Eq. 8 of the paper (L_raydrop), to be summed.

    Args:
        hit: (r,) rendered probability that the ray returns, 0..1.
        is_return: (r,) whether it returned, bool or 0 and 1.
    """
    return (hit - is_return.to(hit)) ** 2


def intensity_loss(intensity_logit: Tensor, true_intensity: Tensor) -> Tensor:
    """Squared error (r,) of intensities 0..1, of rays that returned."""
    return (torch.sigmoid(intensity_logit) - true_intensity) ** 2


def squared_intensity_error(intensity: Tensor, true_intensity: Tensor, is_return: Tensor) -> Tensor:
    """(I^ - I)^2 (r,) of rendered intensities 0..1, 0 where nothing returned.

    Eq. 7 of the paper (L_intensity), to be summed.

    Args:
        intensity: (r,) rendered.
        true_intensity: (r,) recorded.
        is_return: (r,) bool.
    """
    return ((intensity - true_intensity) * is_return) ** 2
