"""The cubic basis by which a table's entries become functions of time."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["NODES", "cubic_basis"]

NODES = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)
"""Times at which one of the four basis functions is 1 and the others are 0."""


def cubic_basis(t: float) -> Tensor:
    """Lagrange's cubic polynomials at a time: ``L_j(t) = product over k != j of (t - t_k) / (t_j - t_k)``.

    They sum to 1, and ``sum of L_j(t) f_j`` is the cubic through the values f_j at the nodes 0, 1/3, 2/3, 1:
    one polynomial for the whole clip, so distant frames are coupled (LiDAR4D; the paper keeps it).

    Args:
        t: in [0, 1], the clip's first and last frame.

    Returns:
        (4,) float64.

    Raises:
        ValueError: The time is outside the clip, where a cubic means nothing.
    """
    if not 0.0 <= t <= 1.0:
        raise ValueError(f"cubic_basis: expected a time in [0, 1], found {t}; frames are 0 to n - 1")
    values = []
    for j, node in enumerate(NODES):
        value = 1.0
        for k, other in enumerate(NODES):
            if k != j:
                value *= (t - other) / (node - other)
        values.append(value)
    return torch.tensor(values, dtype=torch.float64)
