"""The own vehicle's returns, which are at the same place in the sensor's frame wherever the vehicle drives.

Some 140 returns a scan, nearer than 2.5 m, lie on the recording car itself. They are not part of the scene:
they are learned once per drive and added to simulated scans of the recording sensor.

Three facts tell them from the scene. In small cubes of the sensor's frame they are in most scans; cubes and
not rays, because at the car's edges a ray hits it in some scans and misses it in others. No ray of any scan
ever met their places in the world from afar: a wall that runs beside the road is at the same place in the
sensor's frame, too, but was seen before the car reached it, or after. And they end within some metres: a
lorry that keeps beside the car may pass for a part of it by the other two, but its side reaches farther.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nvsf_core.sensors.lasers import elevation_of
from nvsf_core.sensors.tables import LaserTable

NEAR_M = 2.5
"""Only returns nearer than this can be the own vehicle's."""
_VOXEL_M = 0.2
"""Edge of a cube, in the sensor's frame and in the world."""
_MIN_SHARE = 0.5
"""Least share of the path on which a cube, or a cell of the grid, must have a return."""
_AFAR_M = 3.0
"""Farther returns show the world: between the two lies the noise of a range."""
_WORLD_SHARE = 0.5
"""A cube is the world's if more than this share of its returns lies where returns from afar lie, too."""
_LONG_M = 5.0
"""What reaches so far from the sensor is no car's."""
_MOST_STEP_M, _STANDING_M = 1.0, 0.01
"""A scan counts by the path that it stands for, within these limits: waiting at a light proves little, but in
a drive that only stands all scans count alike."""
_BESIDE = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)
_STRIDE = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """One training scan of N returns, in the sensor's frame and in the world."""

    points_m: np.ndarray
    """(N, 3) metres as recorded."""
    intensity: np.ndarray
    """(N,) 0..1."""
    laser: np.ndarray
    """(N,) int; -1 = unknown."""
    world_m: np.ndarray
    """(N, 3) the returns, scene-local metres."""
    position_m: np.ndarray
    """(3,) the sensor, scene-local metres."""


@dataclass(frozen=True, slots=True, eq=False)
class OwnVehicle:
    """Where the own vehicle is in the sensor's frame, and what a grid of L lasers and azimuth cells sees."""

    place: np.ndarray
    """(k, 3) int64 cubes of 0.2 m, counted from the sensor's centre."""
    range_m: np.ndarray
    """(L, cells) float32 metres: median distance from the sensor's centre, 0 = not the own vehicle."""
    intensity: np.ndarray
    """(L, cells) float32: median intensity, 0..1."""

    def is_own(self, points_m: np.ndarray) -> np.ndarray:
        """Whether (N,) bool returns are on the own vehicle: nearer than 2.5 m, in or beside one of its cubes.

        Points (N, 3) are in metres as recorded.
        """
        own: np.ndarray = _distance(points_m) < NEAR_M
        near = np.flatnonzero(own)
        own[near] = _in_or_beside(_cube(points_m[near]), self.place)
        return own


def learn_own_vehicle(
    table: LaserTable, scans: Sequence[PlacedScan], azimuth_cells: int = 2000
) -> OwnVehicle:
    """Learn the own vehicle from training scans in order of time.

    `azimuth_cells` are around the sensor; at most the firings of a sweep, or some stay empty by chance.
    """
    weight = _path_shares(np.array([scan.position_m for scan in scans], np.float64).reshape(-1, 3))
    near = [np.flatnonzero(_distance(scan.points_m) < NEAR_M) for scan in scans]
    of_scan = np.repeat(np.arange(len(scans)), [len(one) for one in near])
    points_m = _gathered([scan.points_m[one] for scan, one in zip(scans, near, strict=True)], 3)
    world_m = _gathered([scan.world_m[one] for scan, one in zip(scans, near, strict=True)], 3)
    cubes, cube = np.unique(_cube(points_m), axis=0, return_inverse=True)
    cube, count = cube.reshape(-1), len(cubes)
    of_world = np.bincount(cube, _seen_from_afar(scans, world_m), count)
    is_worlds = of_world > _WORLD_SHARE * np.bincount(cube, minlength=count)
    place = cubes[(_share_of_path(cube, of_scan, weight, count) >= _MIN_SHARE) & ~is_worlds]
    if len(place) > 0:
        place = place[~_is_of_long(place, scans, weight)]

    own = np.flatnonzero(_in_or_beside(_cube(points_m), place))
    laser = _gathered([scan.laser[one] for scan, one in zip(scans, near, strict=True)])
    shine = _gathered([scan.intensity[one] for scan, one in zip(scans, near, strict=True)])
    row, column = _cells(table, points_m[own], laser[own].astype(np.int64), azimuth_cells)
    cell, size = row * azimuth_cells + column, table.laser_count * azimuth_cells
    wanted = _share_of_path(cell, of_scan[own], weight, size) >= _MIN_SHARE
    shape = (table.laser_count, azimuth_cells)
    return OwnVehicle(
        place=place.astype(np.int64),
        range_m=_medians(cell, _distance(points_m[own]), wanted).reshape(shape),
        intensity=_medians(cell, shine[own], wanted).reshape(shape),
    )


def _path_shares(position_m: np.ndarray) -> np.ndarray:
    """(n,) share of the path that each scan stands for; positions (n, 3) in order of time."""
    step_m = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    around_m = 0.5 * (np.concatenate([[0.0], step_m]) + np.concatenate([step_m, [0.0]]))
    weight = np.clip(around_m[: len(position_m)], _STANDING_M, _MOST_STEP_M)
    return np.asarray(weight / weight.sum())


def _share_of_path(cell: np.ndarray, scan: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """(count,) sum of the weights (n,) of the scans with a return in a cell; of N returns: cell, scan."""
    scans = max(1, len(weight))
    pairs = np.unique(cell * scans + scan)
    share: np.ndarray = np.bincount(pairs // scans, weight[pairs % scans], minlength=count)
    # Rounding must not lose what is in exactly half of the scans.
    return share + 1e-9


def _seen_from_afar(scans: Sequence[PlacedScan], world_m: np.ndarray) -> np.ndarray:
    """Whether (N,) bool places (N, 3), scene-local metres, are in or beside a cube with returns from afar."""
    if len(world_m) == 0:
        return np.zeros(0, bool)
    low, high = world_m.min(axis=0) - 2 * _VOXEL_M, world_m.max(axis=0) + 2 * _VOXEL_M
    afar = []
    for scan in scans:
        is_asked = np.all((scan.world_m > low) & (scan.world_m < high), axis=1)
        is_asked &= _distance(scan.points_m) > _AFAR_M
        afar.append(np.unique(_packed(_cube(scan.world_m[is_asked]))))
    return _packed_in_or_beside(_cube(world_m), np.unique(np.concatenate(afar)))


def _is_of_long(place: np.ndarray, scans: Sequence[PlacedScan], weight: np.ndarray) -> np.ndarray:
    """Whether (k,) bool cubes (k, 3) are of a surface that reaches 5 m from the sensor at the same height.

    At the same height, because a car's wheels stand on the ground, which reaches farther.
    """
    points = [scan.points_m[_distance(scan.points_m) < _LONG_M + _VOXEL_M] for scan in scans]
    of_scan = np.repeat(np.arange(len(scans)), [len(one) for one in points])
    cube = _cube(_gathered(points, 3))
    is_level = (cube[:, 2] >= place[:, 2].min()) & (cube[:, 2] <= place[:, 2].max())
    of_scan, cube = of_scan[is_level], cube[is_level]
    packed, first, each = np.unique(_packed(cube), return_index=True, return_inverse=True)
    is_kept = _share_of_path(each.reshape(-1), of_scan, weight, len(packed)) >= _MIN_SHARE
    packed, surface = packed[is_kept], cube[first[is_kept]]
    # Cubes of other layers are far apart.
    pairs = cKDTree(surface * (1, 1, 8)).query_pairs(1.5, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(surface),) * 2)
    group = connected_components(links, directed=False)[1]
    is_far = np.linalg.norm((surface + 0.5) * _VOXEL_M, axis=1) >= _LONG_M
    long = np.unique(group[is_far])
    return np.isin(group[np.searchsorted(packed, _packed(place))], long)


def _cube(points_m: np.ndarray) -> np.ndarray:
    """(N, 3) int64 cubes that points (N, 3) are in."""
    return np.floor(points_m.astype(np.float64) / _VOXEL_M).astype(np.int64)


def _packed(cube: np.ndarray) -> np.ndarray:
    """(N,) int64: one number a cube (N, 3); cubes lie within 2^19 of 0."""
    return (cube[:, 0] * _STRIDE + cube[:, 1]) * _STRIDE + cube[:, 2]


def _in_or_beside(cube: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Whether (N,) bool cubes (N, 3) are or touch, by a corner at least, one of `places` (k, 3)."""
    return _packed_in_or_beside(cube, _packed(places))


def _packed_in_or_beside(cube: np.ndarray, packed: np.ndarray) -> np.ndarray:
    found, each = np.unique(cube, axis=0, return_inverse=True)
    is_there = np.zeros(len(found), bool)
    for step in _BESIDE:
        is_there |= np.isin(_packed(found + step), packed)
    return np.asarray(is_there[each.reshape(-1)])


def _gathered(parts: Sequence[np.ndarray], columns: int = 0) -> np.ndarray:
    """The parts in one array, also if there are none."""
    return np.concatenate(parts) if parts else np.zeros((0, columns) if columns else 0)


def _medians(cell: np.ndarray, value: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Median value of each wanted cell, 0 elsewhere."""
    medians = np.zeros(len(wanted), np.float32)
    order = np.argsort(cell, kind="stable")
    names, starts = np.unique(cell[order], return_index=True)
    for name, values in zip(names, np.split(value[order], starts[1:]), strict=False):
        if wanted[name]:
            medians[name] = np.median(values)
    return medians


def _cells(
    table: LaserTable, points_m: np.ndarray, laser: np.ndarray, azimuth_cells: int
) -> tuple[np.ndarray, np.ndarray]:
    azimuth = np.mod(np.arctan2(points_m[:, 1], points_m[:, 0]).astype(np.float64), 2.0 * np.pi)
    column = np.floor(azimuth / (2.0 * np.pi) * azimuth_cells).astype(np.int64) % azimuth_cells
    row = laser.astype(np.int64)
    unknown = row < 0
    if unknown.any():
        # Without a laser, the row of the nearest elevation: on the car it is the same in each scan, too.
        middle = 0.5 * (table.elevation_rad[:-1] + table.elevation_rad[1:])
        row[unknown] = np.searchsorted(-middle, -elevation_of(points_m[unknown])[0])
    return row, column


def _distance(points_m: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points_m.astype(np.float64), axis=1)
