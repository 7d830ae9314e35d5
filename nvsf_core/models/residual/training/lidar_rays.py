"""All LiDAR rays that are trained on: what returned, and what was fired and did not."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.raydrop.prior import DropPrior
from nvsf_core.fields.object_surfaces import ObjectSurfaces, join_surfaces
from nvsf_core.sensors.beam_table import corrected_rays
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable


@dataclass(frozen=True, slots=True)
class LidarRays:
    """n rays of the training frames, scene-local."""

    origin_m: np.ndarray
    """(n, 3) float32."""
    direction: np.ndarray
    """(n, 3) float32."""
    range_m: np.ndarray
    """(n,) float32; 0 where nothing returned."""
    intensity: np.ndarray
    """(n,) float32; 0 where nothing returned."""
    hit_prior: np.ndarray
    """(n,) float32: share of the nearest other training scans that returned here."""
    objects: ObjectSurfaces | None = None
    """Moving objects as the other scans prove them, at these rays' times; None where nothing moves."""

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.range_m)


def join_rays(parts: list[LidarRays]) -> LidarRays:
    """One after the other."""
    names = ("origin_m", "direction", "range_m", "intensity", "hit_prior")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    objects = [part.objects for part in parts if part.objects is not None]
    joined = join_surfaces(objects, [len(part) for part in parts]) if objects else None
    return LidarRays(**columns, objects=joined)


def dropped_rays(
    table: LaserTable,
    prior: DropPrior,
    scan: int,
    lasers: np.ndarray,
    trajectory: Trajectory,
    period_s: float,
    near_scans: np.ndarray,
) -> tuple[LidarRays, np.ndarray]:
    """Rays that a training scan fired without a return: the empty cells of its lasers and firings.

    Their angles are the lasers' nominal ones at the firing's own time (n,), which is returned with them.
    """
    fraction = prior.fraction[scan]
    count = int(np.isfinite(fraction).sum())
    laser_row, firing = np.nonzero(~prior.is_hit[scan][lasers][:, :count])
    laser = lasers[laser_row].astype(np.int64)
    when = fraction[firing].astype(np.float64)
    shift = (table.phase_steps - table.firing_shift_steps)[laser] * table.step_rad
    origin, direction = corrected_rays(table, -2.0 * np.pi * when + shift, laser)
    fired_s = prior.time_s[scan] + when * period_s
    origin, direction = trajectory.move_rays(origin, direction, fired_s)
    nothing = np.zeros(len(laser), np.float32)
    hit_prior = prior.hit_prior(laser, when, near_scans)
    rays = LidarRays(origin.astype(np.float32), direction.astype(np.float32), nothing, nothing, hit_prior)
    return rays, fired_s
