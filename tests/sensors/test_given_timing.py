"""Times of points as they are recorded, and whether they fall with the azimuth."""

import numpy as np

from nvsf_core.sensors.given_timing import share_beside_azimuth


def test_times_of_a_sensor_that_is_cut_elsewhere_or_spins_the_other_way_are_beside_it() -> None:
    azimuth = np.linspace(np.pi, -np.pi, 2000, endpoint=False)
    points = np.stack([10.0 * np.cos(azimuth), 10.0 * np.sin(azimuth), np.zeros(2000)], axis=1)
    behind = np.linspace(-0.5, 0.5, 2000)
    assert share_beside_azimuth(points, behind) < 0.01
    assert share_beside_azimuth(points, behind[::-1]) > 0.4
    in_front = np.where(azimuth < 0.0, behind - 0.5, behind + 0.5)
    assert share_beside_azimuth(points, in_front) > 0.9
    assert share_beside_azimuth(points[:0], behind[:0]) == 0.0
