"""What a LiDAR's rays and a camera's pixels answer."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class RenderedRays:
    """Answers of r rays."""

    range_m: np.ndarray
    """(r,) float32 along the ray from its own origin; infinite where nothing answers."""
    hit: np.ndarray
    """(r,) float32: probability of a return."""
    intensity: np.ndarray
    """(r,) float32, 0..1."""
    hit_prior: np.ndarray | None = None
    """(r,) float32: share of the scans that returned there, on a moving object those that saw its place; what
    `hit` started from. None where that is not told."""


@dataclass(frozen=True, slots=True)
class RenderedImage:
    """What a camera shows of a view."""

    rgb: np.ndarray
    """(H, W, 3) uint8."""
    range_m: np.ndarray
    """(H, W) float32 length of each pixel's ray; infinite where nothing answers."""
