"""Returns that the recording car's bonnet mirrors, added to a simulated scan of the recording sensor.

Which rays come back from the bonnet depends on paint, dirt and angle, and changes little from scan to scan:
it is looked up in the two scans beside. Where such a return lies depends on what stands ahead: the ray is
rendered on from the bonnet. At edges, where a slightly different bonnet would mirror something else, the
nearest recorded return says which side is seen.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.beam_table import turn_up
from nvsf_core.sensors.bonnet import Bonnet
from nvsf_core.sensors.sweep import SweepRays
from nvsf_core.simulation.ray_renderers import render_in_chunks
from nvsf_core.simulation.scene_model import RayRenderer

_SCANS = 2
_SMOOTHING_FIRINGS = 2.0
"""Standard deviation of the average over firings: neighbours say more about a ray than its one firing."""
_AGREE_M, _AGREE_PER_RANGE = 2.0, 0.15
"""A rendered return this near to the nearest recorded one is shown: metres, plus metres a metre of range."""
_LEAST_SHARE = 0.25
"""Rays of a smaller share of mirrored returns may look past the bonnet, and are left as they are."""


@dataclass(frozen=True, slots=True, eq=False)
class _Mirrored:
    """The m rays of a sweep that the bonnet mirrors."""

    ray: np.ndarray
    """(m,) int64 their numbers."""
    share: np.ndarray
    """(m,) float32: in what share of the firings around them the scans beside had a mirrored return."""
    nearest: np.ndarray
    """(m,) int64: number, among all returns, of the nearest mirrored one by the same laser."""


# Wide: the sweep, its instant, its rendering and whom to ask on are independent of each other.
def add_mirrored(
    rendered: RenderedRays,
    rays: SweepRays,
    lidar: LidarRecording,
    renderer: RayRenderer,
    time_s: float,
    *,
    leave_out_s: float | None = None,
) -> RenderedRays:
    """Add the returns that the bonnet mirrors; no change for a drive without any.

    Args:
        rendered: Of all r rays of the sweep.
        rays: Of a sweep of the recording sensor at its own pose.
        lidar: The recording.
        renderer: Renders the rays on from the bonnet.
        time_s: Instant of the sweep's pose, seconds since the first frame.
        leave_out_s: The training scan of this time is ignored; None = all are used.
    """
    sweeps = lidar.sweeps
    if sweeps.bonnet is None:
        return rendered
    scans = lidar.evidence.prior.nearest_scans(time_s, _SCANS, leave_out_s=leave_out_s)
    mirrored = _mirrored_rays(rays, lidar, scans)
    if len(mirrored.ray) == 0:
        return rendered
    length_m = _mirrored_length_m(rays, mirrored.ray, lidar, sweeps.bonnet, renderer, time_s)
    recorded_m = sweeps.arrays["range_m"][mirrored.nearest]
    agrees = np.abs(length_m - recorded_m) < _AGREE_M + _AGREE_PER_RANGE * recorded_m
    range_m, hit, intensity = (
        column.astype(np.float32) for column in (rendered.range_m, rendered.hit, rendered.intensity)
    )
    range_m[mirrored.ray] = np.where(agrees, length_m, recorded_m)
    hit[mirrored.ray] = mirrored.share
    intensity[mirrored.ray] = sweeps.arrays["intensity"][mirrored.nearest]
    return RenderedRays(range_m=range_m, hit=hit, intensity=intensity)


def _mirrored_rays(rays: SweepRays, lidar: LidarRecording, scans: np.ndarray) -> _Mirrored:
    """The rays around which the training scans `scans` (k,) had mirrored returns."""
    row_laser, fraction = rays.laser.reshape(rays.shape)[:, 0], rays.fraction[: rays.shape[1]]
    found = [_around(lidar, int(scan)) for scan in scans]
    columns = [lidar.evidence.prior.nearest_firing(int(scan), fraction) for scan in scans]
    share, nearest = (
        np.stack([one[k][row_laser][:, column] for one, column in zip(found, columns, strict=True)])
        for k in range(2)
    )
    chosen = np.take_along_axis(nearest, share.argmax(axis=0)[None], 0).reshape(-1)
    mean = share.mean(axis=0).reshape(-1)
    ray = np.flatnonzero(mean >= _LEAST_SHARE)
    return _Mirrored(ray, mean[ray], chosen[ray])


def _around(lidar: LidarRecording, scan: int) -> tuple[np.ndarray, np.ndarray]:
    """Around each ray of a training scan: share of mirrored returns, and the number of the nearest.

    Both (lasers, firings); the number is by the same laser where the share is not 0.
    """
    sweeps, prior = lidar.sweeps, lidar.evidence.prior
    a, part = sweeps.arrays, sweeps.returns_of(int(np.flatnonzero(sweeps.is_training)[scan]))
    found = np.flatnonzero(a["is_mirrored"][part]) + part.start
    found = found[a["laser"][found] >= 0]
    number = np.full((prior.laser_count, prior.firings_of(scan)), -1, np.int64)
    number[a["laser"][found], prior.nearest_firing(scan, a["sweep_fraction"][found])] = found
    share = np.zeros(number.shape, np.float32)
    for laser in np.unique(a["laser"][found]):
        is_mirrored = number[laser] >= 0
        share[laser] = gaussian_filter1d(is_mirrored.astype(np.float32), _SMOOTHING_FIRINGS, mode="wrap")
        beside = distance_transform_edt(~is_mirrored, return_distances=False, return_indices=True)
        number[laser] = number[laser, beside[0]]
    return share, number


def _mirrored_length_m(
    rays: SweepRays, ray: np.ndarray, lidar: LidarRecording, bonnet: Bonnet, renderer: RayRenderer,
    time_s: float,
) -> np.ndarray:  # fmt: skip
    """(m,) metres by way of the bonnet to the surface that is mirrored; infinite where there is none."""
    sweeps = lidar.sweeps
    distance_m, point_m, onward = bonnet.reflect(rays.recorded_origin_m[ray], rays.recorded_direction[ray])
    point_m, onward = turn_up(point_m, onward, rays.azimuth_rad[ray], sweeps.elevation_correction_rad)
    fired_s = time_s + rays.elapsed[ray] * sweeps.period_s
    origin_m, direction = sweeps.trajectory.move_rays(point_m, onward, fired_s)
    seen = render_in_chunks(
        renderer, origin_m.astype(np.float32), direction.astype(np.float32), np.ones(len(ray), np.float32),
        fired_s,
    )  # fmt: skip
    return distance_m + seen.range_m
