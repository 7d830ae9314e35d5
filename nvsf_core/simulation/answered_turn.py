"""A simulated turn as it is recorded: its points, the scan as a driver stores it, its cells."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.rendering.answers import RayAnswers
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.lidar_rays import SweepRays
from nvsf_core.simulation.scan import HIT_THRESHOLD


@dataclass(frozen=True, slots=True, eq=False)
class AnsweredTurn:
    """r answered rays of a turn, in the sensor's own frame at each firing."""

    rays: SweepRays
    answers: RayAnswers
    is_known: np.ndarray
    """(r,) bool: the ray has an answer at all."""
    point_m: np.ndarray
    """(r, 3) float64; without an answer where the ray starts."""
    distance_m: np.ndarray
    """(r,) float64 of the point from the sensor's centre."""
    azimuth_rad: np.ndarray
    """(r,) float64 of the point, in (-pi, pi]."""
    elevation_rad: np.ndarray
    """(r,) float64 of the point, from the sensor's centre."""

    @staticmethod
    def of(rays: SweepRays, answers: RayAnswers) -> "AnsweredTurn":
        """Points and angles of all rays, computed once."""
        known = np.isfinite(answers.range_m)
        range_m = np.where(known, answers.range_m, 0.0)
        point = rays.recorded_origin_m + rays.recorded_direction * range_m[:, None]
        x, y, z = np.ascontiguousarray(point.T)
        level_m2 = x * x + y * y
        elevation = np.arctan2(z, np.sqrt(level_m2))
        return AnsweredTurn(
            rays, answers, known, point, np.sqrt(level_m2 + z * z), np.arctan2(y, x), elevation
        )

    def scan(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (m, 3) float32, intensity (m,) float32, laser (m,) int16 of what returns.

        Laser by laser from the top, azimuth ascending in [0, 360) degrees within it.
        """
        returned = np.flatnonzero((self.answers.hit >= HIT_THRESHOLD) & self.is_known)
        azimuth = self.azimuth_rad[returned]
        azimuth = np.where(azimuth < 0.0, azimuth + 2.0 * np.pi, azimuth)
        # Rays lie laser by laser: each sorted by itself takes a sixth of the time.
        starts = np.flatnonzero(np.diff(self.rays.laser[returned])) + 1
        orders = [np.argsort(part, kind="stable") for part in np.split(azimuth, starts)]
        order = np.concatenate([own + first for own, first in zip(orders, [0, *starts], strict=True)])
        taken = returned[order]
        return (
            self.point_m[taken].astype(np.float32),
            np.clip(self.answers.intensity[taken], 0, 1).astype(np.float32),
            self.rays.laser[taken].astype(np.int16),
        )

    def grid(self) -> dict[str, np.ndarray]:
        """By laser and firing (l, f) float32: range and angles from the sensor's centre; 0 = no answer."""
        known = self.is_known
        columns = {
            "grid_range_m": np.where(known, self.distance_m, 0.0),
            "grid_hit": np.where(known, self.answers.hit, 0.0),
            "grid_intensity": np.clip(self.answers.intensity, 0.0, 1.0),
            "grid_azimuth_rad": self.azimuth_rad,
            "grid_elevation_rad": self.elevation_rad,
        }
        return {name: column.reshape(self.rays.shape).astype(np.float32) for name, column in columns.items()}

    def pano_hit(self, pano: LinearPano) -> np.ndarray:
        """(H, W) float32 probability that any ray of a cell returned: 1 - prod(1 - p) over its rays."""
        row, column, kept = pano.cells_towards(self.azimuth_rad, self.elevation_rad)
        kept &= self.is_known & (self.distance_m > 0.0) & (self.distance_m < pano.max_range_m)
        missed = np.log1p(-np.clip(self.answers.hit[kept].astype(np.float64), 0.0, 1.0 - 1e-7))
        cell = row[kept] * pano.width + column[kept]
        total = np.bincount(cell, weights=missed, minlength=pano.height * pano.width)
        return -np.expm1(total).reshape(pano.height, pano.width).astype(np.float32)
