"""The recording car's bonnet as a mirror: returns that lie below the road ahead, and what they really show.

A few steep lasers meet the painted bonnet. What is scattered there comes back as the own vehicle's return;
what is mirrored goes on ahead, meets a car or a facade, and comes back the same way. The sensor records it
straight on, as far below the road as the mirrored path is long. Such returns are the same in scan after scan
of a car that stands, yet no surface lies where they are recorded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from nvsf_core.sensors.beam_table import recorded_ray_of_points
from nvsf_core.sensors.own_vehicle import NEAR_M
from nvsf_core.sensors.tables import LaserTable

_STEEP_RAD = np.deg2rad(-12.0)
"""Only rays that look down more steeply can meet the bonnet in front of the road."""
_BELOW_ROAD_M = 1.0
"""A return this much lower than the road is recorded where nothing can be seen."""
_SCALE_M = 0.3
"""Scale of the robust cost of a distance between a mirrored return and what its scan saw there."""
_MOST_APART_M = 3.0
"""Greatest distance that counts, and that of a return whose ray misses the surface."""
_START = (-0.7, 0.0, 0.0, -0.05, -0.05)
"""A bonnet 0.7 m below the sensor, as on a car that carries it on the roof."""
_SPREAD = (0.1, 0.05, 0.05, 0.05, 0.05)
"""How far bonnets differ from the start, term by term: a weak prior that decides where data cannot."""
_MOST_SPREADS = 4.0
"""A surface that differs by more of them is no bonnet: bent enough, a mirror explains anything."""
_LEAST_RETURNS = 20
"""Fewer returns in the whole drive do not determine a surface."""
_EXPLAINED_M, _LEAST_EXPLAINED = 0.5, 0.5
"""At least this share of the returns must lie this near to what their scan saw, or it is not a bonnet."""


@dataclass(frozen=True, eq=False)
class ScanReturns:
    """One scan's N returns; which lie below the road is found once."""

    points_m: np.ndarray
    """(N, 3) metres as recorded, sensor's frame."""
    laser: np.ndarray
    """(N,) int from the top; -1 = unknown."""

    @cached_property
    def is_below_road(self) -> np.ndarray:
        """(N,) bool, see `below_road`."""
        return below_road(self.points_m)

    @cached_property
    def below(self) -> "ScanReturns":
        """The returns below the road alone."""
        return ScanReturns(self.points_m[self.is_below_road], self.laser[self.is_below_road])

    @cached_property
    def others(self) -> cKDTree:
        """Search tree of all others, without the own vehicle's."""
        is_far = np.linalg.norm(self.points_m, axis=1) > NEAR_M
        return cKDTree(self.points_m[~self.is_below_road & is_far])


@dataclass(frozen=True, slots=True)
class Bonnet:
    """A surface z = c0 + c1 x + c2 y + c3 x^2 + c4 y^2 in the sensor's frame (x ahead, y left), metres."""

    shape: np.ndarray
    """(5,) float64: c0 .. c4."""

    def reflect(
        self, origin_m: np.ndarray, direction: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where rays meet the surface, and their directions from there on.

        Args:
            origin_m: (r, 3) metres, sensor's frame.
            direction: (r, 3) unit.

        Returns:
            Distance (r,) to the surface in metres, infinite where it is not met; the point (r, 3), the origin
            there; the mirrored direction (r, 3), unit.
        """
        up, ahead, left, bent_ahead, bent_left = self.shape
        ox, oy, _ = origin_m.T
        dx, dy, dz = direction.T
        # The height of the ray above the surface is a quadratic of the distance.
        second = -(bent_ahead * dx**2 + bent_left * dy**2)
        first = dz - ahead * dx - left * dy - 2.0 * (bent_ahead * ox * dx + bent_left * oy * dy)
        height_m = up + ahead * ox + left * oy + bent_ahead * ox**2 + bent_left * oy**2
        distance_m = _first_root(second, first, origin_m[:, 2] - height_m)
        point_m = origin_m + np.where(np.isfinite(distance_m), distance_m, 0.0)[:, None] * direction
        x, y = point_m[:, 0], point_m[:, 1]
        normal = np.stack([-ahead - 2.0 * bent_ahead * x, -left - 2.0 * bent_left * y, np.ones(len(x))], -1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        across = np.einsum("ri,ri->r", direction, normal)
        return distance_m, point_m, direction - 2.0 * across[:, None] * normal

    def images(self, table: LaserTable, returns: ScanReturns) -> np.ndarray:
        """(N, 3) where mirrored returns really lie, metres, sensor's frame; NaN if they miss the surface."""
        origin_m, direction, range_m = recorded_ray_of_points(table, returns.points_m, returns.laser)
        distance_m, point_m, onward = self.reflect(origin_m, direction)
        rest_m = range_m - distance_m
        rest_m = np.where(np.isfinite(rest_m) & (rest_m > 0.0), rest_m, np.nan)
        return point_m + rest_m[:, None] * onward

    def is_mirrored(self, table: LaserTable, scan: ScanReturns) -> np.ndarray:
        """Whether (N,) bool returns of a scan lie below the road and, mirrored, on another of its returns."""
        mirrored = scan.is_below_road.copy()
        if mirrored.any():
            mirrored[mirrored] = self.apart_m(table, scan) < _EXPLAINED_M
        return mirrored

    def apart_m(self, table: LaserTable, scan: ScanReturns) -> np.ndarray:
        """Metres (n,), at most 3, from a scan's mirrored returns to the nearest of its others.

        These are its n returns below the road, taken to where they really lie.
        """
        images_m = self.images(table, scan.below)
        apart = np.full(len(images_m), _MOST_APART_M)
        met = np.flatnonzero(np.isfinite(images_m).all(axis=1))
        apart[met] = np.minimum(scan.others.query(images_m[met])[0], _MOST_APART_M)
        return apart


def _first_root(second: np.ndarray, first: np.ndarray, zeroth: np.ndarray) -> np.ndarray:
    """(r,) least positive root of second t^2 + first t + zeroth; infinite where there is none."""
    inside = first**2 - 4.0 * second * zeroth
    root = np.sqrt(np.maximum(inside, 0.0))
    # The stable form: none of the two divides by a difference of nearly equal numbers.
    middle = -0.5 * (first + np.where(first < 0.0, -root, root))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([middle / second, zeroth / middle])
    roots[~(np.isfinite(roots) & (roots > 0.0) & (inside >= 0.0))] = np.inf
    return roots.min(axis=0)


def below_road(points_m: np.ndarray) -> np.ndarray:
    """Whether (N,) bool returns (N, 3), metres as recorded, lie far below the road that steep rays meet."""
    distance_m = np.linalg.norm(points_m, axis=1).astype(np.float64)
    sine = points_m[:, 2] / np.maximum(distance_m, 1e-6)
    steep: np.ndarray = (sine < np.sin(_STEEP_RAD)) & (distance_m > NEAR_M)
    if not steep.any():
        return steep
    road_m = float(np.median(points_m[steep, 2]))
    return steep & (points_m[:, 2] < road_m - _BELOW_ROAD_M)


def fit_bonnet(table: LaserTable, scans: Sequence[ScanReturns]) -> Bonnet | None:
    """The bonnet that explains the returns below the road: mirrored, they lie on what their own scan saw.

    Minimises the robust sum of distances from each mirrored return to the nearest other return of its scan.

    Returns:
        The surface, or None where too few returns lie below the road or no bonnet explains half of them.
    """
    asked = [scan for scan in scans if scan.is_below_road.any()]
    if sum(len(scan.below.laser) for scan in asked) < _LEAST_RETURNS:
        return None
    start, spread = np.array(_START), np.array(_SPREAD)

    def apart_m(shape: np.ndarray) -> np.ndarray:
        return np.concatenate([Bonnet(shape).apart_m(table, scan) for scan in asked])

    def cost(shape: np.ndarray) -> np.ndarray:
        return np.concatenate([apart_m(shape) / _SCALE_M, (shape - start) / spread])

    found = least_squares(cost, start, loss="cauchy", diff_step=1e-2, max_nfev=40).x
    is_bonnet = (np.abs(found - start) < _MOST_SPREADS * spread).all()
    is_explained = apart_m(found) < _EXPLAINED_M
    return Bonnet(found) if is_bonnet and is_explained.mean() >= _LEAST_EXPLAINED else None
