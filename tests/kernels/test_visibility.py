"""What other scans of a sensor with few lasers say of a place: whether it was empty when they looked."""

import numpy as np
import pytest

from nvsf_core.kernels.visibility import look_back

SCANS, CELLS, STEP_M = 9, 360, 0.5
OWN_SCAN = SCANS // 2
ELEVATION_RAD = np.deg2rad(np.arange(15.0, -16.0, -2.0))
AHEAD = CELLS // 2
MARGIN_M = 0.3


def place(elevation_rad: float, range_m: float) -> np.ndarray:
    """A point (3,) straight ahead of a sensor in the scene's origin."""
    azimuth = (0.5 - (AHEAD + 0.5) / CELLS) * 2.0 * np.pi
    flat = np.cos(elevation_rad)
    return range_m * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation_rad)])


def scans_that_saw_through(images: np.ndarray, points_m: np.ndarray, x_m: np.ndarray) -> np.ndarray:
    """Counts (m,) for scene-local points (m, 3) of the scan in the middle, the sensor at (x_m, 0, 0)."""
    to_sensor = np.tile(np.eye(3, 4, dtype=np.float32), (SCANS, 1, 1, 1))
    to_sensor[:, 0, 0, 3] = -x_m
    lasers = (ELEVATION_RAD.astype(np.float32), np.zeros(len(ELEVATION_RAD), np.float32), 0.0)
    scans = np.full(len(points_m), OWN_SCAN, np.int32)
    counts = look_back(points_m.astype(np.float32), scans, images, to_sensor, lasers, MARGIN_M, 0.005)
    return counts[:, 0]


@pytest.mark.parametrize("height_m", [1.0, 3.2])
def test_no_scan_sees_through_a_ceiling_between_or_beyond_its_lasers(height_m: float) -> None:
    x_m = (np.arange(SCANS) - OWN_SCAN) * STEP_M
    range_m = np.zeros(len(ELEVATION_RAD))
    range_m[ELEVATION_RAD > 0] = height_m / np.sin(ELEVATION_RAD[ELEVATION_RAD > 0])
    range_m[range_m > 70.0] = 0.0
    images = np.tile(range_m.astype(np.float32)[:, None], (SCANS, 1, CELLS))
    elevation, azimuth = np.meshgrid(ELEVATION_RAD[range_m > 0], np.linspace(-np.pi, np.pi, CELLS))
    flat_m = (height_m / np.tan(elevation)).ravel()
    x, y = flat_m * np.cos(azimuth.ravel()), flat_m * np.sin(azimuth.ravel())
    ceiling = np.stack([x, y, np.full_like(x, height_m)], axis=1)
    assert not scans_that_saw_through(images, ceiling, x_m).any()


def test_what_left_is_seen_through_at_all_heights() -> None:
    wall = np.full((SCANS, len(ELEVATION_RAD), CELLS), 30.0, np.float32)
    points = np.array([place(one, 18.0) for one in np.linspace(*ELEVATION_RAD[[0, -1]], 91)])
    assert np.all(scans_that_saw_through(wall, points, np.zeros(SCANS)) == SCANS - 1)


def test_a_row_that_meets_the_sky_says_nothing() -> None:
    images = np.full((SCANS, len(ELEVATION_RAD), CELLS), 30.0, np.float32)
    images[:, :6] = 0.0
    top = ELEVATION_RAD[6] + 0.2 * (ELEVATION_RAD[5] - ELEVATION_RAD[6])
    seen = scans_that_saw_through(images, place(top, 18.0)[None], np.zeros(SCANS))
    assert seen == [SCANS - 1]


def test_a_surface_may_bend_between_two_rows() -> None:
    images = np.full((SCANS, len(ELEVATION_RAD), CELLS), 20.0, np.float32)
    images[:, 8:] = 14.0
    on_bonnet = ELEVATION_RAD[7] + 0.2 * (ELEVATION_RAD[8] - ELEVATION_RAD[7])
    assert scans_that_saw_through(images, place(on_bonnet, 17.0)[None], np.zeros(SCANS)) == [0]
