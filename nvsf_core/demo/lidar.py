"""The demo's LiDAR: true ranges of all rays at their own times, then noise, mixed pixels and dropped rays.

A ray of laser l at encoder angle theta starts at o = (0, 0, v_l / cos e_l) + h_l (-sin theta, cos theta, 0)
and runs along d = (cos e_l cos theta, cos e_l sin theta, sin e_l); the file records o + r d. In the world
the same ray is turned up by the sensor's elevation correction, in the plane of theta, about the sensor's
centre; files are without it. These rays are computed here and not by `sensors.beam_table`, so that the demo
can test that module.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.demo.motion import FRAME_PERIOD_S
from nvsf_core.demo.shapes import Kind, ShapeList, Shapes, cast_shapes, tile_cones, tile_index, tile_select
from nvsf_core.demo.street import Material
from nvsf_core.demo.world import DemoWorld
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.sensors.tables import HDL_64E, LaserTable

MAX_RANGE_M = 80.0
"""Longest range that is recorded."""
RANGE_NOISE_M = 0.015
"""Standard deviation of the range noise."""
OWN_VEHICLE = -2
"""`instance` of returns from the own vehicle."""

_REFLECTIVITY = {
    Material.SKY: 0.0, Material.ASPHALT: 0.22, Material.MARKING: 0.55, Material.PAVEMENT: 0.33,
    Material.KERB: 0.38, Material.PLASTER: 0.42, Material.GLASS: 0.12, Material.BARK: 0.3,
    Material.LEAF: 0.4, Material.METAL: 0.35, Material.SIGN: 1.3, Material.PAINT: 0.3,
    Material.RUBBER: 0.08, Material.CLOTH: 0.45,
}  # fmt: skip
_GLASS_RETURNS = 0.35
"""Share of pulses on glass that come back; the others pass through or are reflected away."""
_RANDOM_DROPS = 0.008
_HALF_SIGNAL = 2e-6
"""reflectivity x cos incidence / range^2 at which half of the rays are dropped: asphalt at 60 m."""
_MIXED_SHARE = 0.3
"""Share of the pulses at an edge that hit both sides of it."""
_MIXED_STEP_M = (0.15, 2.0)
"""Two surfaces whose ranges differ by this much give one return between them."""


@dataclass(frozen=True, slots=True, eq=False)
class DemoScan:
    """N recorded returns of a sweep: laser by laser from the top, azimuth ascending in [0, 360) degrees."""

    points_m: np.ndarray
    """(N, 3) float32 in the sensor's frame at each return's own time."""
    intensity: np.ndarray
    """(N,) float32 in 0..0.99, in steps of 0.01."""
    laser: np.ndarray
    """(N,) int16, index into the `lasers` of `simulate_scan`."""
    time_s: np.ndarray
    """(N,) float64 of firing, since the first frame."""
    true_range_m: np.ndarray
    """(N,) float32 along the laser's ray, without noise."""
    instance: np.ndarray
    """(N,) int32, number of the object that was hit; `OWN_VEHICLE` = the own vehicle."""


@dataclass(frozen=True, slots=True, eq=False)
class ExactRays:
    """True values of L lasers x F firings, without noise and mixed pixels."""

    range_m: np.ndarray
    """(L, F) float32 along the laser's ray; inf where it hits nothing."""
    chance: np.ndarray
    """(L, F) float64 hit probability; 0 beyond `MAX_RANGE_M`."""
    intensity: np.ndarray
    """(L, F) float64 expected intensity, 0..0.99."""
    instance: np.ndarray
    """(L, F) int32, number of the object that is hit; `OWN_VEHICLE` = the own vehicle."""


# Wide: world, sensor, rays, time and place are independent of each other.
def exact_rays(
    world: DemoWorld,
    table: LaserTable,
    lasers: np.ndarray,
    theta_rad: np.ndarray,
    time_s: np.ndarray,
    *,
    mount: np.ndarray | None,
    own_vehicle: bool,
    path_to_world: np.ndarray | None = None,
) -> ExactRays:
    """True values for any sensor, at any time.

    Args:
        world: The demo's world.
        table: The sensor.
        lasers: (L,) rows of the table.
        theta_rad: (L, F) encoder angles.
        time_s: (L, F) since the first frame.
        mount: (4, 4) pose of the sensor in the path's frame; None = the same pose.
        own_vehicle: Whether the own vehicle is around the sensor, at the same place in the sensor's frame.
        path_to_world: (F, 4, 4) poses of the path at each firing; None = the recording car's at its time.
    """
    origin, direction = _recorded_rays(table, lasers, theta_rad)
    tiles = tile_index(len(lasers), theta_rad.shape[1], 8)
    shapes = _OWN_VEHICLE if own_vehicle else None
    if path_to_world is None:
        pose = world.lidar_to_street(time_s.ravel())
    else:
        pose = np.tile(world.world_to_street @ path_to_world, (len(lasers), 1, 1))
    hit = _cast(
        world, table, origin, direction, theta_rad.ravel(), time_s.ravel(), tiles, pose, mount, shapes
    )
    range_m, material, instance, cosine = (column.reshape(theta_rad.shape) for column in hit)
    present, _, chance, shine = _expected_return(range_m, material, cosine)
    return ExactRays(
        range_m=range_m, chance=present * chance, intensity=np.clip(shine, 0.0, 0.99), instance=instance
    )


def simulate_scan(
    world: DemoWorld, frame: int, lasers: np.ndarray, firings: int, clock: SweepClock | None = None
) -> DemoScan:
    """Simulate the recorded scan of a frame.

    Args:
        world: The demo's world; its seed and the frame's number are the seed of the noise.
        frame: Number of the frame; the instant of its pose is frame x 0.1 s, when the lasers face forward.
        lasers: (L,) indices of the HDL-64E's lasers, from the top.
        firings: Firings a sweep, at most the 4000 steps of the encoder.
        clock: When in the sweep each azimuth is measured; None = clockwise, cut behind.
    """
    rng = np.random.default_rng([world.seed, 1 + frame])
    theta, fraction = _firings(HDL_64E, lasers, firings, rng)
    origin, direction = _recorded_rays(HDL_64E, lasers, theta)
    elapsed = (clock or SweepClock()).elapsed(fraction)
    time_s = (frame + elapsed.ravel()) * FRAME_PERIOD_S
    tiles = tile_index(len(lasers), firings, 8)
    pose = world.lidar_to_street(time_s)
    hit = _cast(world, HDL_64E, origin, direction, theta.ravel(), time_s, tiles, pose, None, _OWN_VEHICLE)
    range_m, material, instance, cosine = hit
    measured, intensity, returned = _measure(
        rng, range_m.reshape(theta.shape), material.reshape(theta.shape), cosine.reshape(theta.shape)
    )
    kept = np.flatnonzero(returned)
    points = (origin[kept] + measured.ravel()[kept, None] * direction[kept]).astype(np.float32)
    laser = kept // firings
    # float64: in float32 a small negative angle modulo 2 pi is rounded up to 2 pi.
    recorded = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    order = np.lexsort((np.mod(recorded, 2.0 * np.pi), laser))
    kept = kept[order]
    return DemoScan(
        points_m=points[order],
        intensity=intensity.ravel()[kept],
        laser=laser[order].astype(np.int16),
        time_s=time_s[kept],
        true_range_m=range_m[kept],
        instance=instance[kept],
    )


def _firings(
    table: LaserTable, lasers: np.ndarray, firings: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Encoder angles theta (L, F) in [0, 2 pi), ascending within a laser, and their sweep fractions (L, F).

    All lasers fire together, one or two steps of the encoder after the last firing (more if there are fewer
    firings), from a random start; each laser's angle is shifted by its constant. A firing at azimuth a in
    (-pi, pi] comes s = -a / 2 pi of a sweep after the pose's instant.
    """
    steps = np.diff(np.arange(firings + 1) * table.lattice_steps // firings)
    start = rng.integers(table.lattice_steps)
    column = np.mod(start + np.cumsum(rng.permutation(steps)), table.lattice_steps)
    half = table.lattice_steps // 2
    fraction = (np.mod(half - column, table.lattice_steps) - half) / table.lattice_steps
    own = np.mod(column[None] - table.firing_shift_steps[lasers][:, None], table.lattice_steps)
    theta = np.mod((own + table.phase_steps[lasers][:, None]) * table.step_rad, 2.0 * np.pi)
    order = np.argsort(theta, axis=1)
    return np.take_along_axis(theta, order, axis=1), fraction[order]


def _recorded_rays(table: LaserTable, lasers: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (L F, 3) float64 in the sensor's frame, as recorded."""
    elevation = table.elevation_rad[lasers][:, None]
    sine, cosine, flat = np.sin(theta), np.cos(theta), np.cos(elevation)
    beside = table.horizontal_offset_m[lasers][:, None]
    above = np.broadcast_to(table.vertical_offset_m[lasers][:, None] / flat, theta.shape)
    origin = np.stack([-beside * sine, beside * cosine, above], axis=-1)
    up = np.broadcast_to(np.sin(elevation), theta.shape)
    direction = np.stack([flat * cosine, flat * sine, up], axis=-1)
    return origin.reshape(-1, 3), direction.reshape(-1, 3)


def _turned_up(vectors: np.ndarray, theta: np.ndarray, angle_rad: float) -> np.ndarray:
    """Vectors (N, 3) rotated upwards by an angle in the vertical plane of theta (N,)."""
    ahead = np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], axis=-1)
    along, up = (vectors * ahead).sum(axis=1), vectors[:, 2]
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    turned: np.ndarray = vectors + (cosine * along - sine * up - along)[:, None] * ahead
    turned[:, 2] = sine * along + cosine * up
    return turned


def _cast(
    world: DemoWorld,
    table: LaserTable,
    origin: np.ndarray,
    direction: np.ndarray,
    theta: np.ndarray,
    time_s: np.ndarray,
    tiles: np.ndarray,
    pose: np.ndarray,
    mount: np.ndarray | None,
    own_vehicle: Shapes | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Range, material, instance and |cos incidence|, each (N,), of the first hits of recorded rays (N, 3).

    `pose` (N, 4, 4) takes the path's frame to the street.
    """
    correction = table.elevation_correction_rad
    origin, direction = _turned_up(origin, theta, correction), _turned_up(direction, theta, correction)
    pose = pose if mount is None else pose @ mount
    turn = pose[:, :3, :3]
    street_origin = (turn @ origin[:, :, None])[..., 0] + pose[:, :3, 3]
    street_direction = (turn @ direction[:, :, None])[..., 0]
    hits = world.cast_in_street(street_origin, street_direction, time_s, tiles)
    cosine = np.abs((hits.normal * street_direction).sum(axis=1))
    range_m, material, instance = hits.range_m, hits.material, hits.instance
    if own_vehicle is None:
        return range_m, material, instance, cosine

    tile_origin, tile_direction = tile_select(origin, tiles), tile_select(direction, tiles)
    none = np.full(tiles.shape, np.inf, np.float32)
    cones = tile_cones(tile_origin, tile_direction)
    own = np.empty_like(range_m)
    own[tiles] = cast_shapes(own_vehicle, tile_origin, tile_direction, none, cones)[0]
    on_own = own < range_m
    range_m[on_own], material[on_own] = own[on_own], Material.PAINT
    instance[on_own], cosine[on_own] = OWN_VEHICLE, 0.5
    return range_m, material, instance, cosine


def _own_vehicle() -> Shapes:
    """The parts of its own car that the LiDAR sees: the bonnet's middle and two roof mounts, within 2.5 m."""
    shapes = ShapeList()
    paint = int(Material.PAINT)
    shapes.add(Kind.ELLIPSOID, np.array([1.9, 0.0, -0.84]), (0.25, 0.2, 0.07), np.eye(3), paint, OWN_VEHICLE)
    for side in (-0.55, 0.55):
        mount = np.array([-1.5, side, -0.67])
        shapes.add(Kind.BOX, mount, (0.03, 0.03, 0.07), np.eye(3), paint, OWN_VEHICLE)
    return shapes.build()


_OWN_VEHICLE = _own_vehicle()


def _measure(
    rng: np.random.Generator, range_m: np.ndarray, material: np.ndarray, cosine: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measured range, intensity and whether the ray returns, each (L, F), from true values (L, F)."""
    shape = range_m.shape
    present, distance, chance, shine = _expected_return(range_m, material, cosine)

    # Mixed pixels: a pulse at an edge is reflected by both surfaces, and the return lies between them.
    beside = np.roll(distance, -1, axis=1)
    jump = np.abs(beside - distance)
    edge = present & np.roll(present, -1, axis=1) & (jump > _MIXED_STEP_M[0]) & (jump < _MIXED_STEP_M[1])
    share = np.where(edge & (rng.random(shape) < _MIXED_SHARE), rng.uniform(0.1, 0.9, shape), 0.0)
    measured = distance + share * (beside - distance) + rng.normal(0.0, RANGE_NOISE_M, shape)

    returned = present & (rng.random(shape) < chance) & (measured < MAX_RANGE_M)
    intensity = np.clip(shine + rng.normal(0.0, 0.02, shape), 0.0, 0.99)
    return measured, (np.round(intensity * 100.0) / 100.0).astype(np.float32), returned


def _expected_return(
    range_m: np.ndarray, material: np.ndarray, cosine: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Expected values of returns, all of one shape.

    Returns:
        Whether the range is below `MAX_RANGE_M`; the range, at most that; the probability that a pulse comes
        back strong enough; the expected intensity, not clipped.
    """
    present = range_m < MAX_RANGE_M
    distance = np.where(present, range_m, np.float32(MAX_RANGE_M))
    reflectivity = np.array([_REFLECTIVITY[kind] for kind in Material])[material]
    signal = reflectivity * np.maximum(cosine, 0.01) / np.maximum(distance, 2.0) ** 2
    chance = 1.0 / (1.0 + (_HALF_SIGNAL / np.maximum(signal, 1e-12)) ** 2)
    chance *= np.where(material == Material.GLASS, _GLASS_RETURNS, 1.0) * (1.0 - _RANDOM_DROPS)
    shine = reflectivity * (0.35 + 0.65 * cosine) * (1.1 - distance / 160.0)
    return present, distance, chance, shine
