"""How far a ray's surfaces lie from its return."""

import torch
from torch import Tensor

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
