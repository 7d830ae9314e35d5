"""How likely the surfaces that a ray may end on make its return."""

import torch
from torch import Tensor

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
