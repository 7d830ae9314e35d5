"""Results of rendering: LiDAR rays and camera images, and how well recorded data support them."""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np


class Support(IntEnum):
    """How well recorded data support a rendered return or pixel; ordered, stored as uint8."""

    GUESSED = 0
    """No observation: no sensor of this kind recorded the place that is shown. So are a LiDAR's returns from
    surfaces that only images show: their ranges are those of depths from images."""
    EXTRAPOLATED = 1
    """The place was recorded, but from elsewhere: along directions or from distances unlike this ray's."""
    SEEN = 2
    """The place was recorded by rays of about the same place and direction."""

    @property
    def region(self) -> str:
        """Name of the part of a scan or an image that has this support, as in the column `region`."""
        return f"support_{self.name.lower()}"


SUPPORTED = "supported"
"""Region of all that is seen or extrapolated."""


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
    on_object: np.ndarray | None = None
    """(r,) bool: the ray ends on a moving object, where `hit` is the hit prior and nothing corrects it. None
    where the renderer does not say."""

    def with_rays(self, rays: np.ndarray, found: "RenderedRays") -> "RenderedRays":
        """A copy in which the rays of indices (k,) have range, hit probability and intensity of `found`."""
        columns = {name: getattr(self, name).copy() for name in ("range_m", "hit", "intensity")}
        for name, column in columns.items():
            column[rays] = getattr(found, name)
        return replace(self, **columns)


@dataclass(frozen=True, slots=True)
class RenderedImage:
    """Colour and range of a camera's pixels."""

    rgb: np.ndarray
    """(H, W, 3) uint8, red first."""
    range_m: np.ndarray
    """(H, W) float32, metres along each pixel's ray; infinite where it meets no surface, as in the sky."""
    support: np.ndarray | None = None
    """(H, W) uint8 class of `Support`, of the colour: the sky is seen, too, and has no range. None = this
    renderer does not know it."""
