"""KISS-ICP where it is installed, and what is said where it is not."""

import sys

import numpy as np
import pytest

from nvsf_core.clouds.odometry import odometry_path
from nvsf_core.errors import DataError, MissingLibraryError
from nvsf_core.metrics.trust.path_error import step_error_m

STEP_M = 0.5


def _corridor(x_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a street with walls and posts, from x_m along it, all at one instant."""
    draws = np.random.default_rng(0)
    place = draws.uniform([-20, -8, -1.7], [20 + 40 * STEP_M, 8, 3], (40_000, 3))
    side = draws.integers(0, 3, len(place))
    place[side == 0, 1] = np.sign(place[side == 0, 1]) * 8.0
    place[side == 1, 2] = -1.7
    post = side == 2
    place[post, 0], place[post, 1] = np.round(place[post, 0] / 6.0) * 6.0, np.sign(place[post, 1]) * 5.0
    return place - [x_m, 0.0, 0.0], np.zeros(len(place))


def test_the_path_of_a_sensor_that_moves_evenly_is_found() -> None:
    pytest.importorskip("kiss_icp", reason="the extra `odometry` is not installed")
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(8)
    found = odometry_path([_corridor(x_m) for x_m in poses[:, 0, 3]])
    assert step_error_m(found[3:], poses[3:]) < 0.05


def test_poses_are_of_the_instants_of_scans_and_not_of_their_ends() -> None:
    pytest.importorskip("kiss_icp", reason="the extra `odometry` is not installed")
    rng, time_s = np.random.default_rng(1), np.arange(14.0)
    scans = []
    for now in time_s:
        seen_m, _ = _corridor(0.0)
        # While it is taken, the sensor drives on as its place says, every point by its own time.
        fraction = rng.uniform(-0.5, 0.5, len(seen_m))
        seen_m[:, 0] -= _place_m(now + fraction)
        scans.append((seen_m, fraction))
    found_m, end_m = odometry_path(scans)[:, 0, 3], _place_m(time_s + 0.5)
    steps = slice(3, None)
    off_m = np.abs(np.diff(found_m) - np.diff(_place_m(time_s)))[steps]
    from_end_m = np.abs(np.diff(end_m) - np.diff(_place_m(time_s)))[steps]
    assert np.median(from_end_m) > 0.035, "ends of sweeps would be far off"
    assert np.median(off_m) < 0.01


def _place_m(time_s: np.ndarray) -> np.ndarray:
    """Place along the street, of a sensor that speeds up by 0.08 m a scan in each scan."""
    return np.asarray(0.3 * time_s + 0.04 * time_s**2)


def test_what_kiss_icp_would_crash_on_is_refused() -> None:
    points_m, fraction = _corridor(0.0)
    points_m[3, 1] = np.nan
    for scan in ((points_m, fraction), (points_m[:3], fraction[:3])):
        with pytest.raises(DataError, match="100 or more finite points a scan, found"):
            odometry_path([scan])


def test_without_kiss_icp_the_command_that_installs_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    with pytest.raises(MissingLibraryError, match=r"not run: .*pip install 'nvsf\[odometry\]'"):
        odometry_path([_corridor(0.0)])
