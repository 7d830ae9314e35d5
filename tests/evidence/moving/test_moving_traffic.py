"""Cars that follow one another through the same places, seen by sixteen lasers, against their truth."""

import numpy as np
import pytest

from nvsf_core.demo.motion import EgoSpeed
from nvsf_core.demo.world import DemoWorld
from nvsf_core.evidence.moving.detection import find_moving_objects
from nvsf_core.evidence.moving.object_evidence import MovingObjects
from tests.evidence.moving.street_drives import StreetDrive, drive_through

FRAMES = 20
LASERS = np.arange(0, 64, 4)
SPEED = EgoSpeed(speeds_m_s=(1.5,))


@pytest.fixture(scope="module")
def traffic() -> tuple[StreetDrive, MovingObjects]:
    drive = drive_through(DemoWorld(5, speed=SPEED, traffic=12), frames=FRAMES, lasers=LASERS, firings=1000)
    return drive, find_moving_objects(drive.returns)


def test_a_place_that_the_next_car_fills_was_left_all_the_same(traffic) -> None:
    drive, moving = traffic
    assert drive.precision(moving) >= 0.95
    assert drive.recall(moving) >= 0.85


def test_voxels_of_objects_grow_as_returns_grow_rare(traffic) -> None:
    _, moving = traffic
    assert 0.2 < moving.density < 0.35
