"""Rays of each laser of a rotating LiDAR, and the range image with one row per laser.

A laser does not fire from the sensor's centre: at the encoder's angle theta its ray starts at
    o = (0, 0, v / cos e) + h (-sin theta, cos theta, 0)
and runs along (elevation e, azimuth theta). Real HDL-64E points lie within 1 mm of such rays.
Recorded points are o + range * direction; the elevation correction is applied only on the way into the world.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.sensors.linear_pano import project_nearest
from nvsf_core.sensors.tables import LaserTable

_LEAST_CONCENTRATION = 0.9
"""Length of the mean of unit vectors at the firings' phases, from which on they agree on one."""
_ROUNDING_STEPS = 1e-3
"""Phases are known to this."""


def sensor_rays(
    table: LaserTable, azimuth_rad: np.ndarray, laser: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays as recorded, in the sensor's frame: origin (..., 3) in metres, unit direction (..., 3), float64.

    By the encoder's angle theta (...) of each, and its laser (...), 0 on top, which broadcast.
    """
    # The table is read before broadcasting: often one laser's rays lie in a row.
    azimuth_rad, laser = np.asarray(azimuth_rad, np.float64), np.asarray(laser)
    elevation = table.elevation_rad[laser]
    cos_a, sin_a = np.cos(azimuth_rad), np.sin(azimuth_rad)
    origin_m = _origins(table, cos_a, sin_a, laser)
    flat = np.cos(elevation)
    direction = _stacked(flat * cos_a, flat * sin_a, np.sin(elevation))
    return origin_m, direction


def corrected_rays(
    table: LaserTable, azimuth_rad: np.ndarray, laser: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`sensor_rays`, turned up by the table's elevation correction, as they go into the world.

    Arguments and result as of `sensor_rays`.
    """
    origin_m, direction = sensor_rays(table, azimuth_rad, laser)
    azimuth_rad = np.broadcast_to(azimuth_rad, origin_m.shape[:-1])
    return turn_up(origin_m, direction, azimuth_rad, table.elevation_correction_rad)


def recorded_ray_of_points(
    table: LaserTable, points_m: np.ndarray, laser: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ray that measured each recorded point: origin + range * direction is the point exactly.

    theta = azimuth - asin(h / rho) with rho the horizontal distance; the elevation is the point's own
    as seen from the laser, which differs from the table's by the sensor's noise only.

    Args:
        table: The sensor.
        points_m: (N, 3) finite points as recorded, in the sensor's frame.
        laser: (N,) laser of each. -1 = unknown: such rays, and those with h > rho, start at the centre.

    Returns:
        origin_m (N, 3), unit direction (N, 3), range_m (N,): sensor's frame, metres, float64.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3 or laser.shape != points_m.shape[:1]:
        raise ShapeError(f"expected points (N, 3) and lasers (N,), found {points_m.shape}, {laser.shape}")
    points_m = points_m.astype(np.float64)
    theta = encoder_angle(table, points_m, laser)
    known = (laser >= 0) & (
        np.hypot(points_m[:, 0], points_m[:, 1]) > np.abs(table.horizontal_offset_m[laser])
    )
    origin_m = np.where(known[:, None], _origins(table, np.cos(theta), np.sin(theta), laser), 0.0)
    ray = points_m - origin_m
    range_m = np.linalg.norm(ray, axis=1)
    direction = ray / np.where(range_m > 0.0, range_m, 1.0)[:, None]
    return origin_m, direction, range_m


def encoder_angle(table: LaserTable, points_m: np.ndarray, laser: np.ndarray) -> np.ndarray:
    """Encoder angle theta (N,) in radians of each recorded point (N, 3), measured by `laser` (N,)."""
    x, y = points_m[:, 0].astype(np.float64), points_m[:, 1].astype(np.float64)
    horizontal_m = np.hypot(x, y)
    offset_m = np.where(laser >= 0, table.horizontal_offset_m[laser], 0.0)
    sine = np.clip(offset_m / np.where(horizontal_m > 0.0, horizontal_m, np.inf), -1.0, 1.0)
    return np.arctan2(y, x) - np.arcsin(sine)


def turn_up(
    origin_m: np.ndarray, direction: np.ndarray, azimuth_rad: np.ndarray, angle_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rays turned up by `angle_rad` about the sensor's centre, each in the vertical plane of its azimuth.

    The axis is (sin theta, -cos theta, 0): a level ray along theta rises. Shapes (..., 3), (..., 3), (...).
    """
    cos_a, sin_a = np.cos(azimuth_rad), np.sin(azimuth_rad)

    def turned(vector: np.ndarray) -> np.ndarray:
        ahead = vector[..., 0] * cos_a + vector[..., 1] * sin_a
        left = -vector[..., 0] * sin_a + vector[..., 1] * cos_a
        up = vector[..., 2]
        ahead, up = (
            ahead * np.cos(angle_rad) - up * np.sin(angle_rad),
            ahead * np.sin(angle_rad) + up * np.cos(angle_rad),
        )
        return np.stack([ahead * cos_a - left * sin_a, ahead * sin_a + left * cos_a, up], axis=-1)

    return turned(origin_m), turned(direction)


def firing_grid(table: LaserTable, firings: int, phase: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Nominal encoder angles and times of one sweep of `firings` evenly spaced firings.

    Firing k is at (k + phase) / firings - 1/2 of a sweep after the pose's instant; laser l then looks
    along theta = -2 pi fraction + (phase_l - firing_shift_l) steps. In recorded scans `phase`, the offset
    of the first firing (0..1), is random; one half is its mean.

    Returns:
        azimuth_rad (L, firings) in (-pi, pi], sweep_fraction (firings,) ascending in (-0.5, 0.5).
    """
    fraction = (np.arange(firings) + phase) / firings - 0.5
    shift_rad = (table.phase_steps - table.firing_shift_steps) * table.step_rad
    return wrap_angle(-2.0 * np.pi * fraction[None, :] + shift_rad[:, None]), fraction


def firing_phase(steps: np.ndarray) -> float:
    """The `phase` of a `firing_grid`, 0..1, on which firings at steps (n,) >= 0 after its begin agree.

    One half where they do not: a sensor that turns freely begins each sweep at another one.
    """
    mean = np.exp(2j * np.pi * steps).mean() if len(steps) else 0.0
    if abs(mean) < _LEAST_CONCENTRATION:
        return 0.5
    phase = float(np.mod(np.angle(mean) / (2.0 * np.pi), 1.0))
    # A phase of 0 must not become 1 by rounding: the sweep's first firing would be its last.
    return 0.0 if phase > 1.0 - _ROUNDING_STEPS else phase


def wrap_angle(angle_rad: np.ndarray) -> np.ndarray:
    """The same angle in (-pi, pi]."""
    wrapped = np.pi - np.mod(np.pi - angle_rad, 2.0 * np.pi)
    # The remainder of a number just below 0 rounds up to 2 pi: -pi, which is outside the interval.
    return np.where(wrapped <= -np.pi, np.pi, wrapped)


@dataclass(frozen=True, slots=True)
class BeamPano:
    """A range image with one row per laser; columns are encoder angles, spaced as in `LinearPano`."""

    table: LaserTable
    width: int = 1030
    """Columns around the sensor."""
    max_range_m: float = 80.0
    """Returns at or beyond it (from the sensor's centre) are dropped."""

    def project(
        self, points_m: np.ndarray, intensity: np.ndarray, laser: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Images (L, W) float32 of range along the laser's ray and of intensity; nearest return, 0.0 = empty.

        Of points (N, 3) as recorded, in the sensor's frame; returns of unknown lasers (-1) are left out.
        """
        _, _, range_m = recorded_ray_of_points(self.table, points_m, laser)
        theta = encoder_angle(self.table, points_m, laser)
        column = np.rint((np.pi - theta) / (2.0 * np.pi / self.width)).astype(np.int64) % self.width
        centre_m = np.linalg.norm(points_m.astype(np.float64), axis=1)
        kept = (laser >= 0) & (centre_m > 0.0) & (centre_m < self.max_range_m)
        shape = (self.table.laser_count, self.width)
        return project_nearest(
            laser[kept].astype(np.int64), column[kept], range_m[kept], intensity[kept], shape
        )

    def points(self, range_m: np.ndarray) -> np.ndarray:
        """Points (N, 3) float64, as a sensor records them, of the filled cells of a range image (L, W)."""
        if range_m.shape != (self.table.laser_count, self.width):
            raise ShapeError(
                f"expected a range image {(self.table.laser_count, self.width)}, found {range_m.shape}"
            )
        laser, column = np.nonzero(range_m > 0.0)
        theta = np.pi - column * (2.0 * np.pi / self.width)
        origin_m, direction = sensor_rays(self.table, theta, laser)
        return origin_m + direction * range_m[laser, column, None].astype(np.float64)


def _origins(table: LaserTable, cos_a: np.ndarray, sin_a: np.ndarray, laser: np.ndarray) -> np.ndarray:
    height_m = table.vertical_offset_m[laser] / np.cos(table.elevation_rad[laser])
    aside_m = table.horizontal_offset_m[laser]
    return _stacked(-aside_m * sin_a, aside_m * cos_a, height_m)


def _stacked(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of coordinates that broadcast against one another."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)
