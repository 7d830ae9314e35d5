"""What a simulation asks of a scene: LiDAR rays and images, whoever answers."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.rendered import RenderedImage, RenderedRays
from nvsf_core.simulation.scan import SweepRays

PRIOR_SCANS = 6
"""Training scans whose drops vote, for a model that does not say how many it was trained with."""


class RayRenderer(Protocol):
    """Answers LiDAR rays."""

    def __call__(
        self, origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray, /
    ) -> RenderedRays:
        """Answer r rays, as many as fit into memory at once (`render_in_chunks` sees to that).

        Args:
            origin_m: (r, 3) float32 scene-local.
            direction: (r, 3) float32 unit, scene-local axes.
            hit_prior: (r,) float32, 0..1: share of the nearest training scans in which this firing returned.
            time_s: (r,) float64 seconds since the first frame: when each ray is fired.
        """


class SweepCorrector(Protocol):
    """Corrects a whole turn of the recording sensor: rays beside each other tell more than each alone."""

    def __call__(self, rays: SweepRays, rendered: RenderedRays, near: np.ndarray, /) -> RenderedRays:
        """Corrected answers.

        Args:
            rays: Of the turn.
            rendered: Of a `RayRenderer`, intensities with their lasers' gain.
            near: (k,) the training scans that vote, nearest in time first.
        """


class ImageRenderer(Protocol):
    """Shows what a camera sees."""

    def __call__(self, camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float, /) -> RenderedImage:
        """Render a whole image.

        Args:
            camera: Name of the drive's camera (`image_00`) that the view is of.
            pinhole: Its intrinsics and size.
            pose: (4, 4) float64 camera to scene-local, wherever the view puts it.
            time_s: Seconds since the first frame.
        """


class PanoRenderer(Protocol):
    """Shows what the papers' range image sees, along its own rays."""

    def __call__(self, pose: np.ndarray, time_s: float, /) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range in metres, intensity, hit probability (66, 1030), all rays from one pose at one time.

        Args:
            pose: (4, 4) float64 LiDAR to scene-local.
            time_s: Seconds since the first frame.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneModel:
    """A scene that can be rendered: a trained field of any family, or a baseline."""

    lidar: RayRenderer | None
    """None where the drive has no LiDAR."""
    camera: ImageRenderer | None
    """None where the drive has no camera."""
    correct: SweepCorrector | None = None
    """None where each ray's answer stands by itself."""
    pano: PanoRenderer | None = None
    """None where a pano is the projection of the simulated scan, and not a view of its own."""
    above: RayRenderer | None = None
    """Answers rays of other sensors that look above all recorded lasers and that `lidar` has no answer for.
    None where nobody knows what is there."""
    unobserved: RayRenderer | None = None
    """Answers rays of the recording sensor in its own place that `lidar` has no answer for, though all scans
    that vote returned there. None where such a ray does not return."""
    prior_scans: int = PRIOR_SCANS
    """Nearest training scans that vote on whether a firing returns; what `RayRenderer` is given."""
    as_recorded: bool = False
    """Whether its LiDAR answers what lasers record, their own errors included: then neither those errors nor
    scans of the sensor at rest are added to it."""
