"""Laws of the demo's other drives: a recording car that stops, and more cars."""

import numpy as np

from nvsf_core.demo.motion import EgoSpeed, ego_pose
from nvsf_core.demo.street import CAR_SIZE_M, build_street


def test_a_car_without_speed_stands_still() -> None:
    time_s = np.linspace(0.0, 3.0, 31)
    poses = ego_pose(time_s, EgoSpeed(speeds_m_s=(0.0,)))
    assert np.ptp(poses, axis=0).max() == 0.0


def test_the_way_is_the_integral_of_the_speed() -> None:
    speed = EgoSpeed((0.0, 0.5, 1.0, 2.0), (4.0, 0.0, 0.0, 6.0))
    time_s = np.linspace(-0.1, 3.0, 31001)
    slope = np.gradient(speed.travelled_m(time_s), time_s)
    np.testing.assert_allclose(slope[1:-1], speed.speed_m_s(time_s)[1:-1], atol=1e-3)
    assert speed.travelled_m(np.zeros(1))[0] == 0.0


def test_cars_of_traffic_are_added_to_the_same_street_and_never_meet() -> None:
    quiet, busy = build_street(3), build_street(3, traffic=12)
    assert np.array_equal(quiet.shapes.instance, busy.shapes.instance)
    assert len(busy.movers) == len(quiet.movers) + 12
    cars = [mover for mover in busy.movers if mover.label == "car"]
    assert len({mover.object_id for mover in busy.movers}) == len(busy.movers)
    place = np.array([mover.motion.pose(np.linspace(0.0, 3.0, 61))[:, :2, 3] for mover in cars])
    apart_m = np.linalg.norm(place[:, None] - place[None], axis=-1)
    other_lane = np.array([[a.motion.speed_m_s * b.motion.speed_m_s < 0 for a in cars] for b in cars])
    least_m = np.where(other_lane, CAR_SIZE_M[1], CAR_SIZE_M[0])
    apart_m[np.arange(len(cars)), np.arange(len(cars))] = np.inf
    assert (apart_m > least_m[..., None]).all()
