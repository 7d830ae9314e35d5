"""The demo's world: exact casting of rays from any place at any time.

Only the demo's writer and scoring use it; training reads files.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.demo.leaves import cast_crowns
from nvsf_core.demo.motion import ROAD_RADIUS_M, EgoSpeed, ego_pose, street_to_world
from nvsf_core.demo.shapes import (
    TILE_RAYS,
    Shapes,
    TileCones,
    cast_shapes,
    describe_hits,
    tile_cones,
    tile_select,
)
from nvsf_core.demo.street import KERB_HEIGHT_M, ROAD_HALF_WIDTH_M, Material, Mover, build_street
from nvsf_core.errors import ShapeError
from nvsf_core.geometry.se3 import invert_pose

HORIZON_M = 300.0
"""Longest range of a hit: farther ground is hidden by haze."""
_INNER_M = ROAD_RADIUS_M - ROAD_HALF_WIDTH_M
_OUTER_M = ROAD_RADIUS_M + ROAD_HALF_WIDTH_M


@dataclass(frozen=True, slots=True, eq=False)
class DemoHits:
    """First hits of N rays."""

    range_m: np.ndarray
    """(N,) float32 along the ray; inf without a hit."""
    material: np.ndarray
    """(N,) int16, of `Material`; SKY without a hit."""
    instance: np.ndarray
    """(N,) int32, number of the object; 0 = ground, -1 = no hit."""
    normal: np.ndarray
    """(N, 3) float32, unit, outwards; 0 without a hit."""
    local_m: np.ndarray
    """(N, 3) float32, place in the shape's own axes (ground, leaves: in the street frame), for textures."""


class DemoWorld:
    """The street of a seed, its moving objects and the recording car's path, at any time.

    World coordinates are as large as KITTI-360's and so float64. Rays are cast in float32 in the street
    frame, exact to 0.1 mm at 100 m.
    """

    def __init__(self, seed: int = 0, *, speed: EgoSpeed | None = None, traffic: int = 0) -> None:
        self.seed = seed
        """Seed of the street and of all noise."""
        self._speed = speed
        self.street = build_street(seed, traffic=traffic)
        """Everything but the ground."""
        self.street_to_world = street_to_world()
        """(4, 4) float64."""
        self.world_to_street = invert_pose(self.street_to_world)
        """(4, 4) float64."""

    def lidar_to_street(self, times_s: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4) float64, recording LiDAR to street, at times (n,)."""
        return ego_pose(times_s, self._speed)

    def lidar_to_world(self, times_s: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4) float64, recording LiDAR to world, at times (n,) since the first frame."""
        return self.street_to_world @ self.lidar_to_street(times_s)

    def object_to_world(self, object_id: int, times_s: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4), moving object to world: x ahead, y left, z up, origin on the road below it.

        Raises:
            KeyError: No moving object has this number.
        """
        movers = {mover.object_id: mover for mover in self.street.movers}
        return self.street_to_world @ movers[object_id].motion.pose(np.atleast_1d(times_s))

    def cast(self, origins_m: np.ndarray, directions: np.ndarray, times_s: np.ndarray) -> DemoHits:
        """First hits of rays in any order; the recording car is not there.

        Args:
            origins_m: (N, 3) float64, world, above the pavement and outside all objects.
            directions: (N, 3), world, unit.
            times_s: (N,) time of each ray, seconds since the first frame.

        Returns:
            N hits, with normals in the world.

        Raises:
            ShapeError: The arrays have other shapes.
        """
        if origins_m.shape != directions.shape or times_s.shape != origins_m.shape[:1]:
            raise ShapeError(
                "expected origins (N, 3), directions (N, 3), times (N,), found "
                f"{origins_m.shape}, {directions.shape}, {times_s.shape}"
            )
        turn = self.world_to_street[:3, :3]
        origins = origins_m @ turn.T + self.world_to_street[:3, 3]
        hits = self.cast_in_street(origins, directions @ turn.T, times_s, _by_direction(directions))
        return DemoHits(
            hits.range_m, hits.material, hits.instance, hits.normal @ turn.astype(np.float32), hits.local_m
        )

    def cast_in_street(
        self, origins_m: np.ndarray, directions: np.ndarray, times_s: np.ndarray, tiles: np.ndarray
    ) -> DemoHits:
        """First hits of rays in any order, in the street frame; the recording car is not there.

        Args:
            origins_m: (N, 3), above the pavement and outside all objects.
            directions: (N, 3), unit.
            times_s: (N,) time of each ray, seconds since the first frame.
            tiles: (T, W) indices of neighbouring rays; each ray at least once.
        """
        origin, direction = tile_select(origins_m, tiles), tile_select(directions, tiles)
        cones = tile_cones(origin, direction)
        best, material = _cast_ground(origin, direction)
        instance = np.where(np.isfinite(best), 0, -1).astype(np.int32)
        normal = np.zeros_like(origin)
        normal[:, 2] = np.isfinite(best)

        best, shape = cast_shapes(self.street.shapes, origin, direction, best, cones)
        best, crown, leaf_normal = cast_crowns(self.street.crowns, origin, direction, best, cones)
        on_leaf = crown >= 0
        shape[on_leaf] = -1
        material[on_leaf] = Material.LEAF
        instance[on_leaf] = self.street.crowns.instance[crown[on_leaf]]
        normal = np.where(on_leaf[:, None], leaf_normal, normal)

        local = origin + np.where(np.isfinite(best), best, 0.0)[:, None] * direction
        _finish_kerb(material, local, normal)
        _fill_in(self.street.shapes, shape, local, (material, instance, normal))
        times = times_s[tiles]
        for mover in self.street.movers:
            _cast_mover(mover, times, (origin, direction), cones, best, (local, material, instance, normal))
        _paint(material, local, normal)
        return _untiled(len(origins_m), tiles, (best, material, instance, normal, local))


def _cast_ground(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range (inf without a hit) and material, both (T, W), of rays on road, kerbs and pavement."""
    z, slope = origin[:, 2], direction[:, 2]
    falls = slope < -1e-7
    safe = np.where(falls, slope, np.float32(-1.0))
    to_walk, to_road = (np.float32(KERB_HEIGHT_M) - z) / safe, -z / safe
    at_walk, at_road = _radius(origin, direction, to_walk), _radius(origin, direction, to_road)
    on_walk = (at_walk < _INNER_M) | (at_walk > _OUTER_M)
    on_road = (at_road >= _INNER_M) & (at_road <= _OUTER_M)
    found = np.where(on_walk, to_walk, to_road)
    material = np.where(on_walk, Material.PAVEMENT, Material.ASPHALT).astype(np.int16)

    # A ray above the road at the pavement's height, and outside it at the road's, hits the kerb between.
    tile, ray = np.nonzero(falls & ~on_walk & ~on_road)
    flat_origin = origin[tile, :2, ray].astype(np.float64)
    flat_direction = direction[tile, :2, ray].astype(np.float64)
    outer = at_road[tile, ray] > _OUTER_M
    square = np.square(flat_direction).sum(axis=1)
    middle = -(flat_origin * flat_direction).sum(axis=1) / square
    nearest = np.square(flat_origin + middle[:, None] * flat_direction).sum(axis=1)
    rest = np.where(outer, _OUTER_M, _INNER_M) ** 2 - nearest
    half = np.sqrt(np.maximum(rest, 0.0) / square)
    found[tile, ray] = middle + np.where(outer, half, -half)
    material[tile, ray] = Material.KERB

    seen = falls & (found < HORIZON_M)
    return np.where(seen, found, np.float32(np.inf)), np.where(seen, material, np.int16(Material.SKY))


def _radius(origin: np.ndarray, direction: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Horizontal distance (T, W) from the street's centre of the points at ranges (T, W) on rays."""
    x = origin[:, 0] + range_m * direction[:, 0]
    y = origin[:, 1] + range_m * direction[:, 1]
    return np.sqrt(x * x + y * y)


def _finish_kerb(material: np.ndarray, local: np.ndarray, normal: np.ndarray) -> None:
    """Set the normals (T, 3, W) of hits on kerbs, which face the road, in place."""
    tile, ray = np.nonzero(material == Material.KERB)
    place = local[tile, :2, ray]
    radius = np.linalg.norm(place, axis=1)
    outward = place / radius[:, None]
    normal[tile, 2, ray] = 0.0
    normal[tile, :2, ray] = np.where((radius > ROAD_RADIUS_M)[:, None], -outward, outward)


def _fill_in(
    shapes: Shapes, shape: np.ndarray, local: np.ndarray, described: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """Set material, instance, normal and `local` of hits on shapes in place; `shape` (T, W) -1 = no hit."""
    material, instance, normal = described
    tile, ray = np.nonzero(shape >= 0)
    index = shape[tile, ray]
    normal[tile, :, ray], local[tile, :, ray] = describe_hits(shapes, index, local[tile, :, ray])
    material[tile, ray] = shapes.material[index]
    instance[tile, ray] = shapes.instance[index]


def _cast_mover(
    mover: Mover,
    times_s: np.ndarray,
    rays: tuple[np.ndarray, np.ndarray],
    cones: TileCones,
    best: np.ndarray,
    described: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Cast rays (T, 3, W) at a moving object, each at its time (T, W); nearer hits are stored in place."""
    local, material, instance, normal = described
    tile = _tiles_near(mover, times_s, cones)
    if len(tile) == 0:
        return
    times = times_s[tile]
    pose = mover.motion.pose(times.ravel())
    turn = pose[:, :3, :3].astype(np.float32).reshape(*times.shape, 3, 3)
    offset = pose[:, :3, 3].astype(np.float32).reshape(*times.shape, 3)
    # Instead of the object the rays are moved: into the object's frame at each ray's time.
    from_object = rays[0][tile] - np.moveaxis(offset, -1, 1)
    origin = np.einsum("twij,tiw->tjw", turn, from_object)
    direction = np.einsum("twij,tiw->tjw", turn, rays[1][tile])
    found, shape = cast_shapes(mover.shapes, origin, direction, best[tile], tile_cones(origin, direction))
    row, ray = np.nonzero(shape >= 0)
    hit_tile, index = tile[row], shape[row, ray]
    at = found[row, ray]
    points = origin[row, :, ray] + at[:, None] * direction[row, :, ray]
    own_normal, local[hit_tile, :, ray] = describe_hits(mover.shapes, index, points)
    normal[hit_tile, :, ray] = np.einsum("nij,nj->ni", turn[row, ray], own_normal)
    best[hit_tile, ray] = at
    material[hit_tile, ray] = mover.shapes.material[index]
    instance[hit_tile, ray] = mover.object_id


def _tiles_near(mover: Mover, times_s: np.ndarray, cones: TileCones) -> np.ndarray:
    """Indices of the tiles whose cones touch a ball around all places of the object during their rays."""
    first, last = times_s.min(axis=1), times_s.max(axis=1)
    centre = mover.motion.pose(0.5 * (first + last))[:, :3, 3]
    fastest_m_s = np.abs(mover.motion.speed_m_s) + np.abs(mover.motion.gain_m_s2) * np.abs(last)
    moved = fastest_m_s * 0.5 * (last - first)
    radius = np.linalg.norm([0.5 * mover.size_m[0], 0.5 * mover.size_m[1], mover.size_m[2]]) + moved
    radius += cones.spread_m
    towards = centre - cones.apex_m
    along = (towards * cones.axis).sum(axis=1)
    across = np.sqrt(np.maximum(np.square(towards).sum(axis=1) - along**2, 0.0))
    sine = np.sqrt(1.0 - cones.cos_angle**2)
    return np.flatnonzero(across * cones.cos_angle - along * sine <= radius)


def _paint(material: np.ndarray, local: np.ndarray, normal: np.ndarray) -> None:
    """Set the material (T, W) of hits on road markings and on windows of houses and cars, in place."""
    tile, ray = np.nonzero(material == Material.ASPHALT)
    x, y = local[tile, 0, ray], local[tile, 1, ray]
    off = np.sqrt(x * x + y * y) - np.float32(ROAD_RADIUS_M)
    along = np.arctan2(y, x) * np.float32(ROAD_RADIUS_M)
    marked = (np.abs(off) < 0.07) & (np.mod(along, 7.0) < 3.0)
    marked |= np.abs(np.abs(off) - 3.55) < 0.05
    material[tile[marked], ray[marked]] = Material.MARKING

    tile, ray = np.nonzero((material == Material.PLASTER) & (np.abs(normal[:, 2]) < 0.5))
    along, height = local[tile, 0, ray], local[tile, 2, ray]
    column, row = np.mod(along + 50.0, 2.3), np.mod(height + 50.0, 2.8)
    window = (column > 0.7) & (column < 1.7) & (row > 0.9) & (row < 2.3)
    material[tile[window], ray[window]] = Material.GLASS

    # Only the cabin has steep sides at this height above the middle of its ellipsoid.
    tile, ray = np.nonzero(material == Material.PAINT)
    height, steep = local[tile, 2, ray], np.abs(normal[tile, 2, ray]) < 0.8
    window = (height > 0.29) & (height < 0.58) & steep
    material[tile[window], ray[window]] = Material.GLASS


def _by_direction(directions: np.ndarray) -> np.ndarray:
    """Tiles (T, W) of rays, sorted by direction in bins of 3 degrees; some rays are repeated to fill up."""
    step = np.deg2rad(3.0)
    azimuth = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) / step).astype(np.int64)
    elevation = np.floor(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)) / step).astype(np.int64)
    order = np.argsort(elevation * 1000 + azimuth, kind="stable")
    count = -(-len(order) // TILE_RAYS) * TILE_RAYS
    return np.resize(order, count).reshape(-1, TILE_RAYS)


def _untiled(
    count: int, tiles: np.ndarray, values: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
) -> DemoHits:
    """Values by tile as hits of `count` rays in their own order; repeated rays have equal values."""
    best, material, instance, normal, local = values
    where = tiles.ravel()
    range_m, kind = np.empty(count, np.float32), np.empty(count, np.int16)
    owner = np.empty(count, np.int32)
    normals, places = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    range_m[where], kind[where], owner[where] = best.ravel(), material.ravel(), instance.ravel()
    for axis in range(3):
        normals[where, axis] = normal[:, axis].ravel()
        places[where, axis] = local[:, axis].ravel()
    return DemoHits(range_m, kind, owner, normals, places)
