"""An object that passes is found in every scan, also in those that nothing links to the others."""

import numpy as np

from nvsf_core.evidence.moving.detection import find_moving_objects
from tests.evidence.moving.street_drives import drive_through, oncoming_car, street_of

FRAMES = 12
SPEED_M_S = 30.0


def test_a_fast_oncoming_car_leaves_nothing_behind_where_it_passes_nearest() -> None:
    world = street_of([oncoming_car(900, SPEED_M_S, met_s=0.6)], speed_m_s=SPEED_M_S)
    drive = drive_through(world, frames=FRAMES, lasers=np.arange(0, 64, 2), firings=1050)
    moving = find_moving_objects(drive.returns)
    assert drive.recall(moving) >= 0.98
    assert drive.precision(moving) >= 0.98
