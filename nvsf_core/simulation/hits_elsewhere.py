"""Hit priors of rays that the recorded unit never fired: of another sensor, or from another place.

Which firing of the recorded unit returned tells nothing about them, but which places returned does. Where a
ray meets a surface of the evidence, the nearest scans are asked whether they had a return there.
"""

import numpy as np

from nvsf_core.evidence.drop_prior import cells_of
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.sensors.sweep import SweepRays
from nvsf_core.simulation.ray_renderers import render_in_chunks, reprojecting_renderer

SCANS = 12
"""Nearest scans that are asked: of some of them the place is hidden, and each single return is chance."""


def hit_prior_elsewhere(
    lidar: LidarRecording, rays: SweepRays, time_s: np.ndarray, near: np.ndarray, *, is_own_unit: bool
) -> np.ndarray:
    """Share (r,) float32 of the scans that looked where rays end which had a return there.

    Args:
        lidar: The recording.
        rays: All r rays of a sweep.
        time_s: (r,) seconds since the first frame, when each ray is fired.
        near: (k,) numbers of the training scans that are asked.
        is_own_unit: Whether the recorded unit fires them: then its gaps are theirs, too.
    """
    evidence = lidar.evidence
    ones = np.ones(len(rays.laser), np.float32)
    met = render_in_chunks(reprojecting_renderer(lidar), rays.origin_m, rays.direction, ones, time_s)
    # A ray that meets nothing ends at no point; along an axis infinity times 0 would be no number.
    ends = ~np.isposinf(met.range_m)
    points_m = np.full(rays.direction.shape, np.inf, np.float32)
    points_m[ends] = rays.origin_m[ends] + rays.direction[ends] * met.range_m[ends, None]
    hit_prior = lidar.scan_grids.hit_prior_at(points_m, near)
    if is_own_unit and evidence.unit_gaps is not None:
        cell = cells_of(rays.fraction, evidence.unit_gaps.shape[1])
        hit_prior[evidence.unit_gaps[rays.laser, cell]] = 0.0
    return hit_prior
