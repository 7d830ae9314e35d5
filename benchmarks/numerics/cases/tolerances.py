"""Largest errors that are allowed: one table for `make stability` and tests/properties.

A number rounded once is wrong by half a unit in the last place. The limits leave room for a few roundings
one after the other, and for sums of a thousand terms, whose roundings add up like a random walk.
"""

import torch

EPS = torch.finfo(torch.float32).eps
ELEMENTWISE_ULP = 8.0
"""Value of a function of one number, in units in the last place of the true value; any data type."""
SUM_EPS = 256.0
"""Result of some thousand additions, in machine epsilons of its largest term; any data type."""
GRADIENT = 2e-5
"""Gradient in float32, relative to the true one."""
LENGTH_M = 1e-9
"""Of geometry in float64, within a scene."""
SHIFTED_POSE_M = 1e-3
"""Of rays and evidence when all poses are moved by some constant: 1 mm, the sensor's own resolution."""
