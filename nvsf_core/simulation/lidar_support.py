"""Support of a simulated sweep's rays: whether recorded rays of about the same place and direction agree.

A ray shows a return or none. Of the nearest scans those tell that looked at its end and were not kept from it
by something nearer. The ray is *seen* if two recorded the same there, from about the same direction and
distance, and none something else: agreement says most about a ray's error. It is *guessed* if its end is
where no return was ever recorded, be it that images or unobserved voxels answer; or, of a ray without an end,
if no scan looked that way. All else is *extrapolated*.
"""

import numpy as np

from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.kernels.ray_agreement import add_agreement, holds_points
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays, Support
from nvsf_core.sensors.own_vehicle import NEAR_M
from nvsf_core.sensors.sweep_rays import SweepRays
from nvsf_core.simulation.raydrop import rays_return

_AGREEING_SCANS = 2
_SHIFT_M = 0.15
"""A field moves a return along its ray by no more than this from the surface that it was recorded on."""
_STEPS = np.stack(np.meshgrid(*[np.arange(-1.0, 2.0)] * 3), axis=-1).reshape(-1, 3)
_NOWHERE_M = 60.0
"""Where a ray without an end is looked up."""


def support_of_sweep(
    lidar: LidarRecording, rays: SweepRays, rendered: RenderedRays, time_s: np.ndarray, near: np.ndarray, *,
    is_own_unit: bool,
) -> np.ndarray:  # fmt: skip
    """Support (r,) uint8, values of `Support`, of all rays of a sweep.

    Args:
        lidar: The recording.
        rays: All r rays.
        rendered: What they show.
        time_s: (r,) seconds since the first frame, when each ray is fired.
        near: (k,) numbers of the training scans that are asked.
        is_own_unit: Whether the recorded unit fires them: its gaps and its own vehicle are known.
    """
    has_end = np.isfinite(rendered.range_m)
    ends_m = rays.origin_m + rays.direction * np.where(has_end, rendered.range_m, _NOWHERE_M)[:, None]
    ends_m = ends_m.astype(np.float32)
    returned = rays_return(rendered.hit) & has_end
    agreed, others = np.zeros((2, len(ends_m)), np.float32)
    looked = np.zeros(len(ends_m), bool)
    for scan in near.tolist():
        found = lidar.scan_grids.look(ends_m, scan, gaps_hide=not is_own_unit)
        position_m = lidar.scan_grids.position_m(scan)
        add_agreement(
            ends_m, rays.direction, rendered.range_m, returned, position_m, found, agreed, others, looked
        )
    is_known = np.where(has_end, _is_recorded(lidar.evidence, rays, ends_m), looked)
    ended = np.flatnonzero(has_end & ~is_known)
    is_known[ended] = _is_on_object(lidar, ends_m[ended], time_s[ended], rays.origin_m[ended])
    support = np.where(is_known, Support.EXTRAPOLATED, Support.GUESSED)
    support[(agreed >= min(_AGREEING_SCANS, len(near))) & (others == 0)] = Support.SEEN
    if is_own_unit:
        support[has_end & (rendered.range_m < NEAR_M)] = Support.SEEN
    return np.asarray(support.astype(np.uint8))


def _is_recorded(evidence: SceneEvidence, rays: SweepRays, ends_m: np.ndarray) -> np.ndarray:
    """Whether (r,) bool a return was recorded in the voxel that a ray ends in, just before or behind it."""
    here = _holds(evidence.surfels, ends_m)
    found = here.copy()
    for shift_m in (-_SHIFT_M, _SHIFT_M):
        found |= _holds(evidence.surfels, ends_m + shift_m * rays.direction)
    if evidence.unobserved is not None:
        # An unobserved voxel lies beside a surface, but nothing was recorded in it.
        found &= here | ~_holds(evidence.unobserved, ends_m)
    return found


def _is_on_object(
    lidar: LidarRecording, ends_m: np.ndarray, time_s: np.ndarray, origin_m: np.ndarray
) -> np.ndarray:
    """Whether (n,) bool places (n, 3), scene-local, lie within a voxel of a moving object's surface then."""
    found, moving = np.zeros(len(ends_m), bool), lidar.moving()
    if moving is None or len(ends_m) == 0:
        return found
    for one in moving.at(time_s, origin_m):
        place_m = one.path.to_object(ends_m.astype(np.float64), time_s)
        for step in _STEPS:
            found |= _holds(one.surfels, place_m + step * one.surfels.index.voxel_m)
    return found


def _holds(surfels: Surfels, points_m: np.ndarray) -> np.ndarray:
    """Whether (n,) bool points (n, 3) lie in the voxel of a surfel."""
    return np.asarray(holds_points(points_m, *surfels.index))
