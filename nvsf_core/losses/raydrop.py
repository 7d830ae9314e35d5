"""Whether a ray returns."""

from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits


def raydrop_loss(hit_logit: Tensor, is_return: Tensor) -> Tensor:
    """Cross-entropy (r,) in nats between a hit logit (r,) and whether the ray returned (r,) 0 or 1."""
    return binary_cross_entropy_with_logits(hit_logit, is_return, reduction="none")
