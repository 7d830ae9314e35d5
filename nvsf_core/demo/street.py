"""The demo street: houses, poles, trees, parked cars, moving cars and a cyclist."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from nvsf_core.demo.leaves import Crowns, make_foliage
from nvsf_core.demo.motion import ROAD_RADIUS_M, ArcMotion, upright_pose
from nvsf_core.demo.shapes import Kind, ShapeList, Shapes

ROAD_HALF_WIDTH_M = 5.5
"""From the road's middle line to either kerb."""
KERB_HEIGHT_M = 0.12
"""Height of the pavement above the road."""
CAR_SIZE_M = (4.3, 1.8, 1.5)
"""Length, width, height of every car."""
_CYCLIST_SIZE_M = (1.75, 0.6, 1.75)
_STREET_RAD = (-1.05, 1.45)
"""Angles between which there are houses; the recording car drives from 0 to 0.36."""


class Material(IntEnum):
    """Material of what a ray hits."""

    SKY = 0
    """No hit."""
    ASPHALT = 1
    """Road."""
    MARKING = 2
    """White paint on the road."""
    PAVEMENT = 3
    """Raised, beside the road."""
    KERB = 4
    """Vertical face of the pavement, and steps of houses."""
    PLASTER = 5
    """Walls."""
    GLASS = 6
    """Windows of houses and cars."""
    BARK = 7
    """Tree trunks."""
    LEAF = 8
    """Tree crowns and bushes."""
    METAL = 9
    """Poles and the bicycle's frame."""
    SIGN = 10
    """Traffic signs, retroreflective."""
    PAINT = 11
    """Car bodies."""
    RUBBER = 12
    """Wheels."""
    CLOTH = 13
    """People."""


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """A moving object."""

    object_id: int
    """Its instance number."""
    label: str
    """Class in the box file."""
    motion: ArcMotion
    """Motion of its frame: x ahead, y left, z up, origin on the road below its centre."""
    shapes: Shapes
    """Its shapes in that frame."""
    size_m: tuple[float, float, float]
    """Length, width, height of its box, whose bottom is on the road."""


@dataclass(frozen=True, slots=True, eq=False)
class ParkedCar:
    """A parked car."""

    object_id: int
    """Its instance number."""
    pose: np.ndarray
    """(4, 4) car to street: x ahead, y left, z up, origin on the road below its centre."""


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """Everything but the ground, in the street frame (see `demo.motion`)."""

    shapes: Shapes
    """All static shapes, the parked cars' included."""
    crowns: Crowns
    """Tree crowns and bushes."""
    movers: tuple[Mover, ...]
    """Moving objects."""
    parked: tuple[ParkedCar, ...]
    """Poses of the parked cars."""


def build_street(seed: int, *, traffic: int = 0) -> Street:
    """Build the street of a seed, with `traffic` more moving cars, which change nothing else."""
    rng = np.random.default_rng([seed, 360])
    shapes = ShapeList()
    _add_houses(shapes, rng)
    _add_poles(shapes, rng)
    crowns = _add_trees(shapes, rng)
    parked = _add_parked_cars(shapes, rng)
    movers = (
        # Oncoming on the inner lane; it passes the recording car in the middle of the drive.
        _mover(1, "car", ArcMotion(ROAD_RADIUS_M - 2.4, 0.44, -8.5), CAR_SIZE_M, _add_car),
        # Ahead on the right; the recording car comes up to 3 m at the end.
        _mover(2, "rider", ArcMotion(ROAD_RADIUS_M + 3.1, 0.2, 4.6), _CYCLIST_SIZE_M, _add_cyclist),
    )
    return Street(shapes.build(), crowns, movers + _traffic(seed, traffic), tuple(parked))


def _traffic(seed: int, cars: int) -> tuple[Mover, ...]:
    """More moving cars, alternately on the inner lane, around the demo's own, and on the outer lane.

    Some brake and others accelerate, but for three seconds none touches another.
    """
    rng = np.random.default_rng([seed, 361])
    inner = [0.44 + step for step in (-0.14, 0.14, -0.28, 0.28, 0.42, 0.56)]
    outer = [0.16 + step for step in (0.0, 0.14, 0.28, 0.42, 0.56, 0.7)]
    movers = []
    for number in range(cars):
        place, is_inner = number // 2, number % 2 == 0
        angle = (inner if is_inner else outer)[place % len(inner)]
        sign, radius = (-1.0, ROAD_RADIUS_M - 2.4) if is_inner else (1.0, ROAD_RADIUS_M + 1.05)
        speed, gain = sign * rng.uniform(8.0, 9.0), rng.uniform(-0.8, 0.8)
        motion = ArcMotion(radius, angle, speed, gain)
        movers.append(_mover(700 + number, "car", motion, CAR_SIZE_M, _add_car))
    return tuple(movers)


def _mover(
    object_id: int,
    label: str,
    motion: ArcMotion,
    size_m: tuple[float, float, float],
    add: Callable[[ShapeList, np.ndarray, int], None],
) -> Mover:
    """A moving object; `add` adds its shapes at a pose to a list."""
    shapes = ShapeList()
    add(shapes, np.eye(4), object_id)
    return Mover(object_id, label, motion, shapes.build(), size_m)


def _place(radius_m: float, angle_rad: float, height_m: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    """Pose (4, 4) at a place of the street: x along the street, y to the curve's centre, z up."""
    heading_rad = angle_rad + 0.5 * np.pi + yaw_rad
    return upright_pose(radius_m, *(np.array([x]) for x in (angle_rad, heading_rad, height_m)))[0]


def _add(
    shapes: ShapeList,
    kind: Kind,
    pose: np.ndarray,
    centre_m: tuple[float, float, float],
    half_m: tuple[float, float, float],
    look: tuple[Material, int],
    axes: np.ndarray | None = None,
) -> None:
    """Add a shape with centre and axes (rows) in the frame of `pose`; `look` is its material and instance."""
    own = pose[:3, :3].T if axes is None else axes @ pose[:3, :3].T
    shapes.add(kind, pose[:3, :3] @ np.array(centre_m) + pose[:3, 3], half_m, own, int(look[0]), look[1])


def _add_houses(shapes: ShapeList, rng: np.random.Generator) -> None:
    instance = 100
    for side in (-1.0, 1.0):
        angle = _STREET_RAD[0]
        while angle < _STREET_RAD[1]:
            length, depth, height = rng.uniform(9.0, 14.0), 8.0, rng.uniform(6.0, 9.5)
            front = ROAD_RADIUS_M + side * (ROAD_HALF_WIDTH_M + rng.uniform(3.3, 4.6))
            angle += 0.5 * length / front
            yaw = rng.uniform(-0.03, 0.03)
            pose = _place(front + side * 0.5 * depth, angle, 0.5 * height, yaw)
            wall = (Material.PLASTER, instance)
            _add(shapes, Kind.BOX, pose, (0.0, 0.0, 0.0), (0.5 * length, 0.5 * depth, 0.5 * height), wall)
            # More than half of the houses have a bay window, all have a step at the door.
            towards_road = side * 0.5 * depth
            if rng.random() < 0.6:
                offset = rng.uniform(-0.25, 0.25) * length
                bay = (offset, towards_road + side * 0.2, 3.9 - 0.5 * height)
                _add(shapes, Kind.BOX, pose, bay, (1.1, 0.45, 1.1), (Material.PLASTER, instance + 1))
            step = (rng.uniform(-0.4, 0.4) * length, towards_road + side * 0.35, 0.25 - 0.5 * height)
            _add(shapes, Kind.BOX, pose, step, (0.7, 0.4, 0.25), (Material.KERB, instance + 2))
            angle += (0.5 * length + (rng.uniform(1.5, 5.0) if rng.random() < 0.4 else 0.0)) / front
            instance += 3


def _add_poles(shapes: ShapeList, rng: np.random.Generator) -> None:
    for number, angle in enumerate(np.arange(_STREET_RAD[0], _STREET_RAD[1], 0.11)):
        side = -1.0 if number % 2 else 1.0
        radius = ROAD_RADIUS_M + side * (ROAD_HALF_WIDTH_M + rng.uniform(0.35, 0.6))
        pose = _place(radius, angle + rng.uniform(-0.02, 0.02))
        instance = 400 + number
        if number % 3 == 0:
            _add(shapes, Kind.CYLINDER, pose, (0.0, 0.0, 1.4), (0.03, 0.03, 1.4), (Material.METAL, instance))
            # A round sign that faces along the street: its axis is the x axis of the pole's frame.
            axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
            disc = (-0.05, 0.0, 2.5)
            _add(shapes, Kind.CYLINDER, pose, disc, (0.3, 0.3, 0.012), (Material.SIGN, instance), axes)
        else:
            _add(shapes, Kind.CYLINDER, pose, (0.0, 0.0, 3.0), (0.07, 0.07, 3.0), (Material.METAL, instance))
            # The lamp is above the road, on whichever side the pole is.
            lamp = (0.0, side * 0.6, 6.0)
            _add(shapes, Kind.BOX, pose, lamp, (0.1, 0.65, 0.06), (Material.METAL, instance))


def _add_trees(shapes: ShapeList, rng: np.random.Generator) -> Crowns:
    centres: list[np.ndarray] = []
    axes: list[np.ndarray] = []
    radii: list[float] = []
    instances: list[int] = []
    for side in (-1.0, 1.0):
        for angle in np.arange(_STREET_RAD[0] + 0.05, _STREET_RAD[1], 0.19):
            where = angle + side * 0.04 + rng.uniform(-0.04, 0.04)
            radius = ROAD_RADIUS_M + side * (ROAD_HALF_WIDTH_M + rng.uniform(1.2, 1.6))
            pose = _place(radius, where, 0.0, rng.uniform(0.0, 3.0))
            crown, trunk = rng.uniform(1.6, 2.2), rng.uniform(0.1, 0.17)
            height = 1.3 + 0.8 * crown
            instance = 500 + len(centres)
            look = (Material.BARK, instance)
            _add(shapes, Kind.CYLINDER, pose, (0.0, 0.0, 0.5 * height), (trunk, trunk, 0.5 * height), look)
            centres.append(pose[:3, 3] + (0.0, 0.0, height))
            axes.append(pose[:3, :3].T)
            radii.append(crown)
            instances.append(instance)
            # A bush a little further on, lower than the LiDAR, so that leaves fill many of its rays.
            bush = rng.uniform(0.5, 0.8)
            pose = _place(radius + side * 0.3, where + 0.05, 0.0, rng.uniform(0.0, 3.0))
            centres.append(pose[:3, 3] + (0.0, 0.0, 0.75 * bush))
            axes.append(pose[:3, :3].T)
            radii.append(bush)
            instances.append(instance + 1)
    return Crowns(
        centre_m=np.stack(centres).astype(np.float32),
        axes=np.stack(axes).astype(np.float32),
        radius_m=np.array(radii, np.float32),
        instance=np.array(instances, np.int32),
        foliage=make_foliage(rng),
    )


def _add_parked_cars(shapes: ShapeList, rng: np.random.Generator) -> list[ParkedCar]:
    parked: list[ParkedCar] = []
    for side in (-1.0, 1.0):
        angle = _STREET_RAD[0]
        while angle < _STREET_RAD[1]:
            angle += rng.uniform(5.2, 12.0) / ROAD_RADIUS_M
            radius = ROAD_RADIUS_M + side * (4.45 + rng.uniform(-0.08, 0.05))
            yaw = rng.uniform(-0.02, 0.02) + (0.0 if side > 0 else np.pi)
            car = ParkedCar(10 + len(parked), _place(radius, angle, 0.0, yaw))
            _add_car(shapes, car.pose, car.object_id)
            parked.append(car)
    return parked


def _add_car(shapes: ShapeList, pose: np.ndarray, instance: int) -> None:
    """A car within `CAR_SIZE_M`: body, rounded ends, rounded cabin, four wheels."""
    paint = (Material.PAINT, instance)
    _add(shapes, Kind.BOX, pose, (0.0, 0.0, 0.55), (1.95, 0.86, 0.27), paint)
    _add(shapes, Kind.ELLIPSOID, pose, (0.9, 0.0, 0.62), (1.25, 0.87, 0.38), paint)
    _add(shapes, Kind.ELLIPSOID, pose, (-0.95, 0.0, 0.62), (1.2, 0.87, 0.42), paint)
    _add(shapes, Kind.ELLIPSOID, pose, (-0.25, 0.0, 0.8), (1.45, 0.78, 0.7), paint)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for x in (-1.3, 1.35):
        for y in (-0.78, 0.78):
            wheel = (Material.RUBBER, instance)
            _add(shapes, Kind.CYLINDER, pose, (x, y, 0.31), (0.31, 0.31, 0.11), wheel, axes)


def _add_cyclist(shapes: ShapeList, pose: np.ndarray, instance: int) -> None:
    """A cyclist within `_CYCLIST_SIZE_M`: two wheels, a frame, legs, a leaning body, arms and a head."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    metal, cloth = (Material.METAL, instance), (Material.CLOTH, instance)
    for x in (-0.52, 0.52):
        wheel = (Material.RUBBER, instance)
        _add(shapes, Kind.CYLINDER, pose, (x, 0.0, 0.34), (0.34, 0.34, 0.02), wheel, axes)
    _add(shapes, Kind.BOX, pose, (0.0, 0.0, 0.62), (0.5, 0.025, 0.04), metal)
    _add(shapes, Kind.BOX, pose, (0.5, 0.0, 0.95), (0.03, 0.27, 0.02), metal)
    lean = 0.45
    cosine, sine = np.cos(lean), np.sin(lean)
    tilted = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    _add(shapes, Kind.ELLIPSOID, pose, (0.02, 0.0, 1.17), (0.15, 0.21, 0.37), cloth, tilted)
    _add(shapes, Kind.ELLIPSOID, pose, (0.27, 0.0, 1.58), (0.11, 0.1, 0.14), (Material.CLOTH, instance))
    for y in (-0.13, 0.13):
        _add(shapes, Kind.ELLIPSOID, pose, (-0.02, y, 0.66), (0.11, 0.08, 0.38), cloth)
        _add(shapes, Kind.ELLIPSOID, pose, (0.3, 1.5 * y, 1.15), (0.28, 0.05, 0.06), cloth)
