"""Whether a place on a moving object returns: the scans that saw the object vote, each where it was then."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving import MovingObject
from nvsf_core.sensors.beam_table import turn_up, wrap_angle
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable

_NEIGHBOUR_WEIGHTS = (1.0, 2.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ObjectVotes:
    """What is needed to look up where a training scan fired at a place of an object."""

    prior: DropPrior
    """Its scans are the training scans that objects are numbered by."""
    lasers: np.ndarray
    """(l,) lasers that ever returned, from the top."""
    trajectory: Trajectory
    table: LaserTable
    elevation_correction_rad: float

    def share(self, path: MovingObject, place_o: np.ndarray, scans: np.ndarray) -> np.ndarray:
        """Share (v,) float32 of `scans` that returned at places (v, 3) of the object's frame.

        Each scan's laser that looks there at the object's own time then is asked for its firing there and
        the two beside it, weighted 1 : 2 : 1.
        """
        total = np.zeros(len(place_o), np.float32)
        for scan in scans:
            time_s = path.time_s[path.scan == scan]
            laser, fraction = self._looks(place_o, path.matrix_at(time_s)[0], time_s)
            firings = self.prior.fraction[scan]
            count = int(np.isfinite(firings).sum())
            middle = np.clip(np.searchsorted(firings[:count], fraction), 1, count - 2)
            for step, weight in zip((-1, 0, 1), _NEIGHBOUR_WEIGHTS, strict=True):
                total += weight * self.prior.is_hit[scan, laser, middle + step]
        return total / np.float32(sum(_NEIGHBOUR_WEIGHTS) * max(len(scans), 1))

    def _looks(
        self, place_o: np.ndarray, pose: np.ndarray, time_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Laser (v,) and sweep fraction (v,) at which the sensor looks at places of an object's frame."""
        rotation, position = self.trajectory.at(time_s)
        in_sensor = (place_o @ pose[:3, :3].T + pose[:3, 3] - position[0]) @ rotation[0]
        azimuth = np.arctan2(in_sensor[:, 1], in_sensor[:, 0])
        recorded, _ = turn_up(in_sensor, in_sensor, azimuth, -self.elevation_correction_rad)
        flat, range_m = np.hypot(recorded[:, 0], recorded[:, 1]), np.linalg.norm(recorded, axis=1)
        elevation = np.arctan2(recorded[:, 2], flat)
        table, lasers = self.table, self.lasers.astype(np.int64)
        looks = table.elevation_rad[lasers] + table.vertical_offset_m[lasers] / range_m[:, None]
        laser = lasers[np.abs(looks - elevation[:, None]).argmin(axis=1)]
        theta = azimuth - np.arcsin(np.clip(table.horizontal_offset_m[laser] / flat, -1.0, 1.0))
        shift = (table.phase_steps - table.firing_shift_steps)[laser] * table.step_rad
        return laser, -wrap_angle(theta - shift) / (2.0 * np.pi)
