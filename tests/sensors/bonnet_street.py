"""A level street with a wall ahead, seen by a HDL-64E whose car mirrors a part of its rays."""

import numpy as np

from nvsf_core.sensors.beam_table import firing_grid, sensor_rays
from nvsf_core.sensors.bonnet import Bonnet, ScanReturns
from nvsf_core.sensors.tables import HDL_64E

ROAD_M, WALL_M = -1.73, 18.0
FIRINGS = 500
SHAPE = np.array([-0.72, -0.03, 0.01, -0.03, -0.09])


def ranges_of_street(origin_m: np.ndarray, direction: np.ndarray, wall_m: float = WALL_M) -> np.ndarray:
    """(r,) metres to a level road or a wall ahead, whichever is nearer; infinite without either."""
    with np.errstate(divide="ignore"):
        road = (ROAD_M - origin_m[:, 2]) / direction[:, 2]
        wall = (wall_m - origin_m[:, 0]) / direction[:, 0]
    return np.minimum(np.where(road > 0.0, road, np.inf), np.where(wall > 0.0, wall, np.inf))


def scan_of_street(bonnet: Bonnet | None) -> tuple[ScanReturns, np.ndarray]:
    """A scan of the street, mirrored by the part of the bonnet that is in view, and which returns are."""
    azimuth, _ = firing_grid(HDL_64E, FIRINGS)
    laser = np.repeat(np.arange(64), FIRINGS)
    origin_m, direction = (
        ray.reshape(-1, 3) for ray in sensor_rays(HDL_64E, azimuth, np.arange(64)[:, None])
    )
    range_m, mirrored = ranges_of_street(origin_m, direction), np.zeros(len(laser), bool)
    if bonnet is not None:
        distance_m, point_m, onward = bonnet.reflect(origin_m, direction)
        mirrored = np.isfinite(distance_m) & (point_m[:, 0] > 1.5) & (point_m[:, 0] < 3.2)
        mirrored &= np.abs(point_m[:, 1]) < 0.5
        range_m = np.where(mirrored, distance_m + ranges_of_street(point_m, onward), range_m)
    met = np.isfinite(range_m) & (range_m < 80.0)
    points_m = (origin_m + range_m[:, None] * direction)[met].astype(np.float32)
    return ScanReturns(points_m, laser[met]), mirrored[met]
