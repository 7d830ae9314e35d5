"""Laws of what recorded panos say of an expected one: a round wall, a sensor that drives through it."""

import numpy as np

from nvsf_core.models.residual.pano_neighbours import RecordedPanos, ask_neighbours
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.sweep_clock import SweepClock

PANO = LinearPano(reference_quirks=True)
STEP_M, RADIUS_M = 1.0, 15.0
TIMES_S = np.arange(3) * 0.1


def drive() -> RecordedPanos:
    """Three scans a metre apart of a round wall that is brighter on the left, all fired at once."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.arange(3) * STEP_M
    found = [_wall(pose[:3, 3]) for pose in poses]
    trajectory = Trajectory(TIMES_S, poses, np.eye(4))
    ranges, shines = (np.stack(images).astype(np.float32) for images in zip(*found, strict=True))
    return RecordedPanos(TIMES_S, ranges, shines, trajectory, 0.0, (SweepClock(),) * len(TIMES_S), 0.0)


def _wall(centre_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    direction = PANO.directions()
    flat = np.linalg.norm(direction[..., :2], axis=-1)
    along = (direction[..., :2] @ centre_m[:2]) / flat
    level_m = -along + np.sqrt(along**2 + RADIUS_M**2 - centre_m[:2] @ centre_m[:2])
    return level_m / flat, np.where(direction[..., 1] > 0, 0.8, 0.2)


def test_a_wall_is_where_the_neighbours_have_it() -> None:
    panos = drive()
    found = ask_neighbours(panos, np.array([0, 2]), panos.range_m[1], TIMES_S[1], PANO)
    inner = found.same[8:-8]
    assert inner.mean() > 0.98 and found.through[8:-8].mean() < 0.01
    assert np.abs(found.offset_m).max() < 0.4 and np.abs(found.offset_m[8:-8]).mean() < 0.02
    assert abs(found.intensity[20, 257] - 0.8) < 0.05 and abs(found.intensity[20, 772] - 0.2) < 0.05
    assert (found.filled == 1.0).all()


def test_what_stands_before_a_wall_is_seen_through_and_what_lacks_is_empty() -> None:
    panos = drive()
    expected_m = np.where(np.arange(PANO.width) < 500, 6.0, panos.range_m[1]).astype(np.float32)
    panos.range_m[0, :, 600:] = 0.0
    found = ask_neighbours(panos, np.array([0]), expected_m, TIMES_S[1], PANO)
    assert found.through[10:-10, 50:450].mean() > 0.98 and not found.same[10:-10, 50:450].any()
    assert found.empty[10:-10, 700:900].mean() > 0.98
    assert (found.filled[:, 600:] == 0.0).all() and (found.filled[:, :600] == 1.0).all()


def test_nothing_is_said_of_cells_where_nothing_is_expected() -> None:
    panos = drive()
    expected_m = panos.range_m[1].copy()
    expected_m[:, ::2] = 0.0
    found = ask_neighbours(panos, np.array([0, 2]), expected_m, TIMES_S[1], PANO)
    for name in ("same", "through", "empty", "intensity", "offset_m"):
        assert not getattr(found, name)[:, ::2].any()
    assert found.same[:, 1::2].any()
