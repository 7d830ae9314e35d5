"""What a LiDAR ray answers."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class RayAnswers:
    """Answers of r rays."""

    range_m: np.ndarray
    """(r,) float32 along the ray from its own origin; infinite where nothing answers."""
    hit: np.ndarray
    """(r,) float32: probability of a return."""
    intensity: np.ndarray
    """(r,) float32, 0..1."""
