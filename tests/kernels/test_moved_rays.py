"""The kernel against the same motions in numpy, one after the other."""

import numpy as np
import pytest

from nvsf_core.geometry.se3 import exp_so3, pose_from_parts
from nvsf_core.kernels.moved_rays import move_sweep
from nvsf_core.sensors.beam_table import firing_grid, sensor_rays, turn_up
from nvsf_core.sensors.tables import HDL_64E

FIRINGS = 90
MOUNT = pose_from_parts(exp_so3(np.array([0.1, -0.2, 0.9])), np.array([0.4, -1.2, 0.7]))


@pytest.mark.parametrize("mount", [np.eye(4), MOUNT], ids=["in place", "mounted"])
def test_rays_are_turned_up_mounted_and_moved_by_their_firings_pose(mount: np.ndarray) -> None:
    azimuth, fraction = firing_grid(HDL_64E, FIRINGS)
    origin, direction = sensor_rays(HDL_64E, azimuth, np.arange(64)[:, None])
    rotation = exp_so3(np.column_stack([0.02 * fraction, 0.01 * fraction, 0.3 * fraction]))
    position = np.column_stack([9.0 * fraction, 0.2 * fraction, 0.0 * fraction]) + 100.0
    found = move_sweep(origin, direction, azimuth, 0.02, mount, rotation, position)
    turned = turn_up(origin, direction, azimuth, 0.02)
    expected = (
        np.einsum("fij,lfj->lfi", rotation, turned[0] @ mount[:3, :3].T + mount[:3, 3]) + position,
        np.einsum("fij,lfj->lfi", rotation, turned[1] @ mount[:3, :3].T),
    )
    for moved, exact in zip(found, expected, strict=True):
        assert moved.dtype == np.float32 and moved.shape == (64 * FIRINGS, 3)
        np.testing.assert_allclose(moved.reshape(64, FIRINGS, 3), exact, atol=1e-5)
