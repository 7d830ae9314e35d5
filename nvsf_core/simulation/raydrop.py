"""Ray drop: which rays return, from blended hit probabilities, by a threshold or at random.

The field's ray head and the raydrop network each give a hit probability. Their errors differ from each other
and from drive to drive. So their logits are blended by logistic regression (Platt scaling of two scores): the
weights and the offset maximise the likelihood of left-out scans. A rendered scan holds the rays of
probability 0.4 or more, and one of two neighbours where one of them more likely returns than none; in a data
set the returns are sampled at random.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

_HIT_THRESHOLD = 0.4
"""Below one half, as the two errors do not cost the same: a missing return leaves a hole, one too many mostly
lies among others on the same surface (docs/lean_trials.md)."""
_EVEN_CHANCE = 0.5
"""Of a pair of rays, and of the papers' panos, whose metrics take a probability above it for a return."""
SAMPLING_SHARPNESS = 3.0
"""Factor of hit logits before sampling, as real rays are dropped in patches and not one by one."""
_PULL = 1e-4
"""Weight of the squared distance to the start, in nats: matters only where firings leave a weight open."""


def rays_return(hit: np.ndarray) -> np.ndarray:
    """Whether rays return, bool of the shape of their hit probabilities (..., firings), in order of firing.

    A ray of probability 0.4 or more returns. Of two neighbouring firings that are both below it, the likelier
    one returns if any of the two more likely does than none, by ``1 - (1 - p) (1 - q) >= 1 / 2``: a window of
    which one ray in three returns is no hole.
    """
    returns = np.asarray(hit >= _HIT_THRESHOLD)
    paired = hit.shape[-1] // 2 * 2
    first, second = hit[..., 0:paired:2], hit[..., 1:paired:2]
    empty = ~(returns[..., 0:paired:2] | returns[..., 1:paired:2])
    filled = empty & (1.0 - (1.0 - first) * (1.0 - second) >= _EVEN_CHANCE)
    returns[..., 0:paired:2] |= filled & (first >= second)
    returns[..., 1:paired:2] |= filled & (first < second)
    return returns


def cells_return(hit: np.ndarray) -> np.ndarray:
    """Whether pixels of a pano show a return, bool of any shape, by the threshold of the papers' protocol."""
    return hit > _EVEN_CHANCE


@dataclass(frozen=True, slots=True)
class HitBlend:
    """Blend of two hit logits: network * network_logit + ray_head * ray_head_logit + offset."""

    network: float
    ray_head: float
    offset: float

    def logit(self, network_logit: np.ndarray, ray_head_logit: np.ndarray) -> np.ndarray:
        """The blended logit; all arrays of one shape."""
        return self.network * network_logit + self.ray_head * ray_head_logit + self.offset


EVEN = HitBlend(network=0.5, ray_head=0.5, offset=0.0)
"""Start of a fit."""


def nats(logit: np.ndarray, returned: np.ndarray) -> float:
    """Mean cross-entropy, in nats, of hit logits (n,) and whether the rays returned (n,) bool; n >= 1."""
    return float(np.mean(np.logaddexp(0.0, np.where(returned, -logit, logit))))


def fit_blend(network_logit: np.ndarray, ray_head_logit: np.ndarray, returned: np.ndarray) -> HitBlend:
    """The blend of least cross-entropy of hit logits (n,) of the same firings; no weight is negative.

    The raydrop network must not have been trained on the scans of these firings; `returned` (n,), n >= 1.
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
    """Move probabilities, of any shape, towards 0 and 1: q = sigmoid(sharpness * logit(p) + b), float64.

    b is found by bisection so that the expected number of hits, their sum, is kept. With a sharpness of 1
    nothing changes.
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
    return 1.0 / (1.0 + np.exp(-np.clip(logit + 0.5 * (low + high), -60.0, 60.0)))
