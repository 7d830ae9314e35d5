"""Named terms, weighted and added; a term that is not finite is an error, never a 0."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError


@dataclass(frozen=True, slots=True)
class LossBreakdown:
    """The loss of one step."""

    total: Tensor
    """Scalar, differentiable."""
    terms: dict[str, float]
    """Mean of each unweighted term, in its own unit."""


def total_loss(terms: dict[str, Tensor], weights: dict[str, float]) -> LossBreakdown:
    """Mean of each term (r,) times its weight, added. An empty term (no ray of its kind) counts as absent.

    Raises:
        DivergedError: A term is NaN or infinite; names it.
    """
    means = {name: term.mean() for name, term in terms.items() if term.numel()}
    for name, value in means.items():
        if not torch.isfinite(value):
            raise DivergedError(
                f"loss term {name!r} is {value.item()}; lower the step size or look at its input"
            )
    total = torch.stack([weights[name] * value for name, value in means.items()]).sum()
    return LossBreakdown(total, {name: float(value.detach()) for name, value in means.items()})
