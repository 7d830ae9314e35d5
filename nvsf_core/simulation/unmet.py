"""Rays that meet no surface though the scans beside returned there: they show what the nearest of these did.

Where returns are few, as of four lasers or of a road far away, a ray may pass between all that was recorded.
What the same laser measured a moment before, into the same direction from the sensor, is then the best guess:
the ground lies at the same range again. It tells nothing of another sensor or place.
"""

import numpy as np

from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays


def copy_unmet(
    rendered: RenderedRays,
    laser: np.ndarray,
    fraction: np.ndarray,
    hit_prior: np.ndarray,
    lidar: LidarRecording,
    scans: np.ndarray,
) -> RenderedRays:
    """Give rays that meet no surface the range and intensity of the nearest scan that returned there.

    Such are the rays of which at least the share `SceneEvidence.copied_share` of the scans returned. That
    share is their hit probability.

    Args:
        rendered: Of r rays of the recording sensor in its own place, in the convention of stored scans.
        laser: (r,) row of the sensor's table; -1 = unknown, which is not copied.
        fraction: (r,) -azimuth / 2 pi of the rays' firings, -0.5..0.5.
        hit_prior: (r,) float32, share of the scans that returned.
        lidar: The recording.
        scans: (k,) numbers of the training scans of the hit prior, nearest in time first.
    """
    is_copied = ~np.isfinite(rendered.range_m) & (laser >= 0) & (hit_prior >= lidar.evidence.copied_share)
    unmet = np.flatnonzero(is_copied)
    if len(unmet) == 0:
        return rendered
    grids = lidar.scan_grids
    range_m, intensity = np.zeros((2, len(unmet)), np.float32)
    for scan in scans.tolist():
        cell = (scan, laser[unmet], grids.prior.nearest_firing(scan, fraction[unmet]))
        is_open = range_m == 0.0
        range_m = np.where(is_open, grids.range_m[cell], range_m)
        intensity = np.where(is_open, grids.intensity[cell], intensity)
    return rendered.with_rays(unmet, RenderedRays(range_m, hit_prior[unmet], intensity))
