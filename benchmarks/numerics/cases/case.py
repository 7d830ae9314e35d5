"""One row of the table of hard cases: which function, what is hard about its inputs, how it is checked."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.tolerances import GRADIENT

NOT_APPLICABLE = "n/a"
NOT_ON_GPU = "not run on a GPU"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What a case found."""

    error: float | None = None
    """Largest error, compared with the case's limit; None where the outcome is no number."""
    gradient: float | None = None
    """Largest relative error of the gradient, infinite where it is not finite; None = no gradient."""
    gradient_limit: float = GRADIENT
    """How large that may be."""
    cuda: float | str = NOT_APPLICABLE
    """Largest error on CUDA, or why there is none."""
    outcome: str = ""
    """What happened, where that is more than a number."""


@dataclass(frozen=True, slots=True)
class Case:
    """A shipped function, a range of inputs, and the check of its results."""

    function: str
    """Where it is: module and name below nvsf_core."""
    inputs: str
    """What is hard, in words and numbers."""
    check: Callable[[], Reading | float | str]
    """Runs it: the largest error, or what came out in words, or both. A broken law is an AssertionError."""
    limit: float = 0.0
    """How large the error may be."""
    unit: str = ""
    """Of both."""


def refused(kind: type[Exception], *calls: Callable[[], object]) -> Callable[[], str]:
    """A check that each call raises an error of this kind; the first error's first words are the outcome."""

    def check() -> str:
        said = []
        for call in calls:
            try:
                result = call()
            except kind as error:
                said.append(f"{type(error).__name__}: {str(error)[:90]}")
            else:
                raise AssertionError(f"no error, but {str(result)[:90]}")
        return said[0]

    return check


def largest(found: np.ndarray | Tensor, exact: np.ndarray | Tensor | float) -> float:
    """Largest absolute difference, counted in float64; infinite where one is NaN."""
    apart = float(np.abs(np.asarray(found, np.float64) - np.asarray(exact, np.float64)).max())
    return apart if apart == apart else float("inf")


def finite_gradient(loss: Tensor, *leaves: Tensor) -> float:
    """0 where the loss has a finite gradient by every leaf, infinite where it has not."""
    found = torch.autograd.grad(loss, leaves)
    return 0.0 if all(bool(gradient.isfinite().all()) for gradient in found) else float("inf")
