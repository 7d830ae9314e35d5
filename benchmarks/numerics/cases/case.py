"""One row of the table of hard cases: what is checked, and what was found."""

import math
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["NOT_APPLICABLE", "NOT_ON_GPU", "Case", "Gradient", "Reading", "finite_or_fail", "refused"]

NOT_APPLICABLE = "n/a"
NOT_ON_GPU = "not run on a GPU"


@dataclass(frozen=True, slots=True)
class Gradient:
    """The gradient over a case's whole input range."""

    is_finite: bool
    """Every component."""
    error: float
    """Largest relative error against the reference's."""
    limit: float
    """How large it may be."""

    @property
    def is_right(self) -> bool:
        """Finite, and within the limit."""
        return self.is_finite and self.error <= self.limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What a case found."""

    error: float | None = None
    """Largest error; None where the outcome is no number."""
    limit: float = 0.0
    """How large the error may be."""
    unit: str = ""
    """Of both."""
    gradient: Gradient | None = None
    """None where nothing is differentiated."""
    float32: str = NOT_APPLICABLE
    """How float32 on the CPU did; n/a where the function works in float64 or on integers."""
    reduced: str = NOT_APPLICABLE
    """How bfloat16 and float16 did."""
    cuda: str = NOT_APPLICABLE
    """How float32 on CUDA did."""
    outcome: str = ""
    """What happened, where that is more than a number."""
    is_refuted: bool = False
    """A check beyond the error failed; `outcome` says which."""

    @property
    def is_ok(self) -> bool:
        """Everything within its limits; NaN is not."""
        columns = (self.float32, self.reduced, self.cuda)
        return (
            not self.is_refuted
            and (self.error is None or self.error <= self.limit)
            and (self.gradient is None or self.gradient.is_right)
            and not any(column.startswith("fail") for column in columns)
        )


@dataclass(frozen=True, slots=True)
class Case:
    """A function and a range of inputs."""

    function: str
    """Where it is: module and name below nvsf_core."""
    inputs: str
    """In words and numbers."""
    check: Callable[[], Reading]
    """Runs it."""


def refused(kind: type[Exception], call: Callable[[], object]) -> Reading:
    """Outside the domain there has to be an error of this kind; its first words are the outcome."""
    try:
        result = call()
    except kind as error:
        return Reading(outcome=f"{type(error).__name__}: {str(error)[:90]}")
    except Exception as error:  # any other error is a finding, and the table goes on
        return Reading(outcome=f"{type(error).__name__}, not {kind.__name__}: {error}", is_refuted=True)
    return Reading(outcome=f"no error, but {str(result)[:90]}", is_refuted=True)


def finite_or_fail(is_finite: bool, error: float) -> float:
    """The error, or infinity where something was not finite."""
    return error if is_finite and not math.isnan(error) else math.inf
