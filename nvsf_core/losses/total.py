"""The total loss: named terms, weighted and added. A term that is not finite is an error, never 0."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nvsf_core.errors import DivergedError


@dataclass(frozen=True, slots=True)
class LossBreakdown:
    """The loss of one step."""

    total: Tensor
    """Scalar, differentiable."""
    terms: dict[str, float]
    """Mean (or sum) of each unweighted term, in its own unit."""
    reduced: dict[str, Tensor] = field(default_factory=dict)
    """The same, differentiable: to find the term with a broken gradient when there is one."""

    def scaled(self, share: float) -> "LossBreakdown":
        """The loss and its terms, times `share`: of a part of a step."""
        return LossBreakdown(
            self.total * share,
            {name: value * share for name, value in self.terms.items()},
            {name: value * share for name, value in self.reduced.items()},
        )


def total_loss(
    terms: dict[str, Tensor], weights: dict[str, float], sums: Collection[str] = ()
) -> LossBreakdown:
    """Sum over unreduced terms of weight times mean, or times sum for those in `sums`.

    An empty term (no ray of its kind) is left out; without any the total is 0. Eq. 10 of the paper: lambda_1
    L_flow + ... + lambda_6 L_rgb, with sums over rays (`PaperLosses`). Weights of other terms are ignored.

    Raises:
        DivergedError: A term is NaN or infinite; names it.
    """
    reduced = {
        name: term.sum() if name in sums else term.mean() for name, term in terms.items() if term.numel()
    }
    if not reduced:
        return LossBreakdown(torch.zeros((), requires_grad=True), {})
    # All at once: each number that a GPU is asked for waits for all that it has yet to do.
    values = torch.stack([value.detach().double() for value in reduced.values()]).tolist()
    for name, found in zip(reduced, values, strict=True):
        if not math.isfinite(found):
            raise DivergedError(f"loss term {name!r} is {found}; lower the step size or look at its input")
    total = torch.stack([weights[name] * value for name, value in reduced.items()]).sum()
    return LossBreakdown(total, dict(zip(reduced, values, strict=True)), reduced)
