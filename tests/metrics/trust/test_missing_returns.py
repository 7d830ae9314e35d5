import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.trust.missing_returns import missing_share

FIRINGS = 1000
RADIUS_M = 12.0
"""Of a round wall about the origin, seen from anywhere inside."""


def _rays(elevation_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    azimuth_rad = np.linspace(np.pi, -np.pi, FIRINGS, endpoint=False) - 1e-3
    return np.broadcast_to(azimuth_rad, (len(elevation_deg), FIRINGS)), np.deg2rad(elevation_deg)


def _wall(sensor_m: tuple[float, float, float]) -> np.ndarray:
    """Returns from all of the wall, in the frame of a sensor that stands there."""
    angle = np.repeat(np.linspace(-np.pi, np.pi, 4 * FIRINGS), 60)
    height_m = np.tile(np.linspace(-3.0, 3.0, 60), 4 * FIRINGS)
    return np.stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), height_m], axis=1) - sensor_m


def _share(returned: np.ndarray, elevation_deg: np.ndarray, sensor_m=(0.0, 0.0, 0.0)) -> float:
    return missing_share(*_rays(elevation_deg), returned, [_wall(sensor_m)] * 2, max_range_m=100.0)


@pytest.mark.parametrize("elevation_deg", [np.linspace(4.0, -8.0, 40), np.linspace(6.0, -6.0, 7)])
@pytest.mark.parametrize("sensor_m", [(0.0, 0.0, 0.0), (3.0, -2.0, 0.5)])
def test_rays_that_are_dropped_are_missing_for_any_sensor_and_place(elevation_deg, sensor_m) -> None:
    whole = np.ones((len(elevation_deg), FIRINGS), bool)
    assert _share(whole, elevation_deg, sensor_m) == 0.0
    dark = whole.copy()
    dark[:, : FIRINGS // 10] = False
    assert _share(dark, elevation_deg, sensor_m) == pytest.approx(0.1, abs=0.03)
    assert _share(np.zeros_like(whole), elevation_deg, sensor_m) == 1.0


def test_a_ray_that_only_one_scan_answered_or_none_is_not_missing() -> None:
    elevation_deg = np.linspace(4.0, -8.0, 40)
    whole, none = np.ones((40, FIRINGS), bool), np.zeros((40, FIRINGS), bool)
    wall = _wall((0.0, 0.0, 0.0))
    half = wall[wall[:, 1] > 0.0]
    left = whole.copy()
    left[_rays(elevation_deg)[0] < 0.0] = False
    assert missing_share(*_rays(elevation_deg), left, [wall, half], max_range_m=100.0) < 0.005
    assert np.isnan(missing_share(*_rays(elevation_deg), none, [wall, wall[:0]], max_range_m=100.0))
    assert np.isnan(missing_share(*_rays(elevation_deg), none, [], max_range_m=100.0))


def test_a_sensor_of_short_range_misses_nothing_that_lies_beyond() -> None:
    elevation_deg = np.linspace(4.0, -8.0, 40)
    none = np.zeros((40, FIRINGS), bool)
    wall = [_wall((0.0, 0.0, 0.0))] * 2
    assert np.isnan(missing_share(*_rays(elevation_deg), none, wall, max_range_m=10.0))
    assert missing_share(*_rays(elevation_deg), none, wall, max_range_m=20.0) == 1.0


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"azimuths and returns \(L, F\)"):
        missing_share(np.zeros((2, 3)), np.zeros(2), np.zeros((2, 4), bool), [], max_range_m=100.0)
