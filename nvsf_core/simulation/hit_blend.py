"""How far two answers to one question are believed: a ray returns, say the network and the ray head.

Both err, and differently, and how much so is another thing in every drive. Their weights, and an offset, are
those under which left-out scans are most likely (Platt's scaling of two scores): probabilities, not just a
choice at one half.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

_PULL = 1e-4
"""Nats a unit, squared, that it costs to leave the start: decides only where firings leave it open."""


@dataclass(frozen=True, slots=True)
class HitBlend:
    """The logit network * l_n + ray_head * l_r + offset."""

    network: float
    ray_head: float
    offset: float

    def logit(self, network_logit: np.ndarray, ray_head_logit: np.ndarray) -> np.ndarray:
        """Of a return, from both answers' logits, all of one shape."""
        found: np.ndarray = self.network * network_logit + self.ray_head * ray_head_logit + self.offset
        return found


EVEN = HitBlend(network=0.5, ray_head=0.5, offset=0.0)
"""Where a fit starts."""


def nats(logit: np.ndarray, returned: np.ndarray) -> float:
    """Mean cross-entropy of logits (n,) of a return with whether there was one (n,) bool; n at least 1."""
    return float(np.mean(np.logaddexp(0.0, np.where(returned, -logit, logit))))


def fit_blend(network_logit: np.ndarray, ray_head_logit: np.ndarray, returned: np.ndarray) -> HitBlend:
    """The blend of least cross-entropy, from firings (n,) of scans that neither answer has seen; n >= 1.

    No weight is negative: an answer that is worse than none is not asked.
    """
    columns = np.stack([network_logit, ray_head_logit, np.ones(len(returned))]).astype(np.float64)
    start = np.array([EVEN.network, EVEN.ray_head, EVEN.offset])

    def cost(weights: np.ndarray) -> tuple[float, np.ndarray]:
        logit, moved = weights @ columns, weights - start
        slope = columns @ (expit(logit) - returned) / len(returned)
        return nats(logit, returned) + _PULL * float(moved @ moved), slope + 2.0 * _PULL * moved

    bounds = [(0.0, None), (0.0, None), (None, None)]
    weights = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return HitBlend(*(float(weight) for weight in weights))
