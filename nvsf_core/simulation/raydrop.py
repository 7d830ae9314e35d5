"""Which rays return: probabilities blended, held against a threshold, or sampled.

A LiDAR's ray comes back or is dropped. The ray head of a field and the network over the sensor's own grid
each give a probability; both err, and differently, and how much so is another thing in every drive. So their
logits are blended with the weights, and the offset, under which left-out scans are most likely (Platt's
scaling of two scores). A rendered scan holds the rays whose probability reaches one half; a data set samples
them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

HIT_THRESHOLD = 0.5
SAMPLING_SHARPNESS = 3.0
"""How far hit probabilities are pushed to 0 and 1 before sampling: lasers drop patches, not single rays."""
_PULL = 1e-4
"""Nats a unit, squared, that it costs to leave the start: decides only where firings leave it open."""


def rays_return(hit: np.ndarray) -> np.ndarray:
    """Whether rays return, bool of any shape, by their hit probabilities.

    A tie of the votes is a return: counting ties as drops costs range PSNR.
    """
    returns: np.ndarray = hit >= HIT_THRESHOLD
    return returns


def cells_return(hit: np.ndarray) -> np.ndarray:
    """Whether cells of a pano show a return, bool of any shape, as the papers' protocol decides it."""
    returns: np.ndarray = hit > HIT_THRESHOLD
    return returns


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


def sharpen_hits(probability: np.ndarray, sharpness: float = SAMPLING_SHARPNESS) -> np.ndarray:
    """Push probabilities towards 0 and 1 while their sum stays: q = sigmoid(sharpness logit(p) + b).

    Args:
        probability: Any shape, 0..1.
        sharpness: 1 leaves them as they are.

    Returns:
        The same shape, float64; b is found by bisection so that the expected number of hits is kept.
    """
    p = np.clip(probability.astype(np.float64), 1e-6, 1.0 - 1e-6)
    if p.size == 0:
        return p
    logit = sharpness * (np.log(p) - np.log1p(-p))
    low, high = -50.0, 50.0
    for _ in range(40):
        shift = 0.5 * (low + high)
        expected = np.mean(1.0 / (1.0 + np.exp(-np.clip(logit + shift, -60.0, 60.0))))
        low, high = (shift, high) if expected < p.mean() else (low, shift)
    sharpened: np.ndarray = 1.0 / (1.0 + np.exp(-np.clip(logit + 0.5 * (low + high), -60.0, 60.0)))
    return sharpened


def sample_returns(hit: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Whether rays return, bool of any shape, sampled from their sharpened hit probabilities."""
    returns: np.ndarray = generator.random(hit.shape) < sharpen_hits(hit)
    return returns
