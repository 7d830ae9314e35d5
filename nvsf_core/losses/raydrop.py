"""Whether a ray returns."""

from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits


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
