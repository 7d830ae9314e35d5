"""Hit priors of rays that the recorded unit never fired."""

from dataclasses import replace

import numpy as np

from nvsf_core.simulation.hits_elsewhere import hit_prior_elsewhere
from tests.simulation.test_lidar_support import NEAR, PERIOD_S, all_hit, recorded, standing


def test_of_rays_that_meet_nothing_along_an_axis_no_scan_tells() -> None:
    is_hit = all_hit()
    is_hit[1] = False
    lidar, (_, rays) = recorded(is_hit), standing()
    # Straight up, where nothing is: there 0 m forward times infinity is no number.
    upwards = np.arange(len(rays.laser)) % 2 == 0
    direction = np.where(upwards[:, None], np.float32([0.0, 0.0, 1.0]), rays.direction)
    fired_s = np.full(len(rays.laser), PERIOD_S)
    found = hit_prior_elsewhere(lidar, replace(rays, direction=direction), fired_s, NEAR, is_own_unit=False)
    assert (found[upwards] == 1.0).all()
    np.testing.assert_allclose(found[~upwards], 2.0 / 3.0, atol=1e-6)
