"""The interface between simulation and models: what a model of a scene can render."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recording.drive import ScanLookups
from nvsf_core.rendering.rendered import RenderedImage, RenderedRays
from nvsf_core.sensors.sweep import SweepRays


class RayRenderer(Protocol):
    """Renders LiDAR rays."""

    def __call__(
        self, origin_m: np.ndarray, direction: np.ndarray, hit_prior: np.ndarray, time_s: np.ndarray, /
    ) -> RenderedRays:
        """Render r rays, all at once; `render_in_chunks` keeps r small enough for memory.

        Args:
            origin_m: (r, 3) float32 scene-local, metres.
            direction: (r, 3) float32 unit, scene-local axes.
            hit_prior: (r,) float32, 0..1: share of the nearest training scans in which this firing returned.
            time_s: (r,) float64 seconds since the first frame: when each ray is fired.
        """


class SweepCorrector(Protocol):
    """Corrects a whole sweep of the recording sensor, using the rays beside each ray."""

    def __call__(self, rays: SweepRays, rendered: RenderedRays, lookups: ScanLookups, /) -> RenderedRays:
        """Correct a rendered sweep.

        Args:
            rays: All rays of the sweep.
            rendered: By a `RayRenderer`; intensities with their lasers' gain.
            lookups: In the training scans of the hit prior.
        """


class ImageRenderer(Protocol):
    """Renders camera images."""

    def __call__(
        self, camera: str, pinhole: Pinhole, pose: np.ndarray, time_s: float, /, near_s: float | None = None
    ) -> RenderedImage:
        """Render a whole image.

        Args:
            camera: Name of the drive's camera, as `image_00`.
            pinhole: Its intrinsics.
            pose: (4, 4) float64 camera to scene-local frame, of the view.
            time_s: Instant of what moves, seconds since the first frame.
            near_s: When the drive was nearest to the pose: what is static is looked up there. None =
                `time_s`.
        """


class PanoRenderer(Protocol):
    """Renders the papers' pano (66 x 1030) along its own rays."""

    def __call__(self, pose: np.ndarray, time_s: float, /) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range in metres, intensity, hit probability, each (66, 1030); all rays from one pose at one time.

        Args:
            pose: (4, 4) float64 LiDAR to scene-local frame.
            time_s: Seconds since the first frame.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneModel:
    """What a trained field of any family, or a baseline, can render of a scene."""

    lidar: RayRenderer | None
    """None where the drive has no LiDAR."""
    camera: ImageRenderer | None
    """None where the drive has no camera."""
    correct: SweepCorrector | None = None
    """None where rays are rendered one by one."""
    pano: PanoRenderer | None = None
    """None where a pano is the projection of the simulated scan."""
    above: RayRenderer | None = None
    """For rays of other sensors that look above all recorded lasers and for which `lidar` finds no surface.
    None = such rays do not return."""
    copies_unmet: bool = False
    """Whether rays of the recording sensor in its own place that meet no surface are copied from scans that
    returned there, see `copy_unmet`. Else such rays do not return."""
    prior_scans: int = 6
    """Number of nearest training scans in the hit prior."""
    as_recorded: bool = False
    """Its LiDAR was trained on recorded values, with each laser's range bias and intensity gain. Then neither
    these nor stationary scans are added by the simulation."""
