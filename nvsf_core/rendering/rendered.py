"""Results of rendering: LiDAR rays and camera images."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class RenderedRays:
    """Range, hit probability and intensity of r LiDAR rays."""

    range_m: np.ndarray
    """(r,) float32, metres from the ray's own origin; infinite where the ray meets no surface."""
    hit: np.ndarray
    """(r,) float32, 0..1: hit probability."""
    intensity: np.ndarray
    """(r,) float32, 0..1."""
    hit_prior: np.ndarray | None = None
    """(r,) float32, 0..1: the hit prior that `hit` started from, the share of nearby scans that returned; on
    moving objects, of scans that saw the same place on them. None where the renderer gives none."""


@dataclass(frozen=True, slots=True)
class RenderedImage:
    """Colour and range of a camera's pixels."""

    rgb: np.ndarray
    """(H, W, 3) uint8, red first."""
    range_m: np.ndarray
    """(H, W) float32, metres along each pixel's ray; infinite where it meets no surface."""
    support: np.ndarray | None = None
    """(H, W) uint8 class of `Support`; None = this renderer does not know it."""
