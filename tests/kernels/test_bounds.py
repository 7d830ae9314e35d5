"""Laws of finding the rays that cross a moving thing's bounds: numpy's own path and slabs are the oracle."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import MovingObject
from nvsf_core.kernels.bounds import MovingBounds, rays_into_bounds

FRAME_S = 0.1
LOW_M, HIGH_M = np.array([-2.0, -0.9, -0.2]), np.array([2.2, 0.9, 1.5])
EVERYWHERE = (np.zeros(3), -1.0)
NO_TIME = np.zeros(1)


def path(scans: int) -> MovingObject:
    """A thing that drives a curve past the origin."""
    scan = np.arange(scans, dtype=np.int32)
    x, y, yaw = 2.6 * scan - 6.0, 4.0 + scan, 2.9 + 0.14 * scan
    pose = np.column_stack([x, y, 0.3 * np.cos(x), yaw])
    return MovingObject(scan, scan * FRAME_S, pose, FRAME_S, LOW_M, HIGH_M)


def rays(count: int, last_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays around the origin, all along the path's time and a little beyond."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 3)) * [1.0, 1.0, 0.2]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = rng.uniform(-0.2, 0.2, (count, 3))
    return origin.astype(np.float32), direction.astype(np.float32), rng.uniform(-0.2, last_s + 0.2, count)


def crossing(thing: MovingObject, origin, direction, time_s, *, cone=EVERYWHERE):
    first_s, last_s = thing.there_s
    box = MovingBounds(*cone, first_s, last_s, thing.time_s, thing.pose, LOW_M, HIGH_M)
    return rays_into_bounds(origin, direction, time_s, box)


def by_numpy(thing: MovingObject, origin, direction, time_s) -> np.ndarray:
    """Rays whose points, a centimetre apart, are ever inside the bounds in the object's frame."""
    inside = np.zeros(len(time_s), bool)
    for range_m in np.arange(0.0, 20.0, 0.01):
        place = thing.to_object(origin + direction * range_m, time_s)
        inside |= ((place > LOW_M) & (place < HIGH_M)).all(axis=1)
    return np.flatnonzero(inside & thing.is_there(time_s))


def test_the_rays_that_cross_are_those_with_a_point_inside() -> None:
    for scans in (1, 2, 6):
        thing = path(scans)
        origin, direction, time_s = rays(3000, thing.time_s[-1])
        found, _, _ = crossing(thing, origin, direction, time_s)
        stepped = by_numpy(thing, origin, direction, time_s)
        assert 20 < len(stepped) < 1500
        # Steps of a centimetre miss a corner that is cut by less, and nothing else.
        assert np.isin(stepped, found).all()
        assert len(found) - len(stepped) <= 3


def test_their_rays_come_in_its_frame_at_their_own_times() -> None:
    thing = path(6)
    origin, direction, time_s = rays(3000, thing.time_s[-1])
    found, origin_o, direction_o = crossing(thing, origin, direction, time_s)
    assert origin_o.dtype == direction_o.dtype == np.float32
    far = origin[found] + 7.0 * direction[found].astype(np.float64)
    assert np.allclose(thing.to_object(origin[found], time_s[found]), origin_o, atol=1e-5)
    assert np.allclose(thing.to_object(far, time_s[found]), origin_o + 7.0 * direction_o, atol=1e-5)


def test_rays_outside_the_cone_are_not_asked() -> None:
    thing = path(6)
    origin, direction, time_s = rays(3000, thing.time_s[-1])
    everyone, _, _ = crossing(thing, origin, direction, time_s)
    ahead, _, _ = crossing(thing, origin, direction, time_s, cone=(np.array([0.0, 1.0, 0.0]), 0.8))
    assert ahead.tolist() == [ray for ray in everyone.tolist() if direction[ray, 1] >= np.float32(0.8)]
    assert 0 < len(ahead) < len(everyone)


def test_rays_along_an_axis_cross_what_they_start_between() -> None:
    thing = MovingObject(np.array([0], np.int32), NO_TIME, np.zeros((1, 4)), FRAME_S, LOW_M, HIGH_M)
    origin = np.array([[-9.0, 0.0, 0.0], [-9.0, 0.95, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32)
    direction = np.tile(np.array([[1.0, 0.0, 0.0]], np.float32), (4, 1))
    found, _, _ = crossing(thing, origin, direction, np.zeros(4))
    assert found.tolist() == [0, 3]


def test_a_thing_that_no_scan_saw_is_nowhere_and_no_rays_are_none() -> None:
    thing = path(6)
    origin, direction, time_s = rays(100, thing.time_s[-1])
    assert len(crossing(thing, origin[:0], direction[:0], time_s[:0])[0]) == 0
    nobody = MovingObject(thing.scan[:0], thing.time_s[:0], thing.pose[:0], FRAME_S, LOW_M, HIGH_M)
    assert len(crossing(nobody, origin, direction, time_s)[0]) == 0
