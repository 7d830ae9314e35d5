"""How wrong a result may be, by data type: the one table that `make stability` and tests/properties share.

A number rounded once is wrong by half a unit in the last place. The limits leave room for a few roundings
one after the other, and for sums of a thousand terms, whose roundings add up like a random walk.
"""

from dataclasses import dataclass

import torch

__all__ = ["LENGTH_M", "SHIFTED_POSE_M", "TOLERANCES", "Tolerance"]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What is allowed of one data type."""

    elementwise_ulp: float
    """Value of a function of one number, in units in the last place of the true value."""
    sum_eps: float
    """Result of some thousand additions, in machine epsilons of its largest term."""
    gradient: float
    """Gradient, relative to the true one."""


TOLERANCES = {
    torch.float64: Tolerance(8.0, 256.0, 1e-11),
    torch.float32: Tolerance(8.0, 256.0, 2e-5),
    # Worked on in float32 and rounded once; a gradient is rounded twice.
    torch.bfloat16: Tolerance(1.0, 4.0, 2e-2),
    torch.float16: Tolerance(1.0, 4.0, 4e-3),
}
LENGTH_M = 1e-9
"""Of geometry in float64, within a scene."""
SHIFTED_POSE_M = 1e-3
"""Of rays and evidence when all poses are moved by some constant: 1 mm, the sensor's own resolution."""
