import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.trust.scan_statistics import (
    COLUMNS,
    ScanGrid,
    hit_rate_by_laser,
    hits_differ,
    incidence_distance_deg,
    incidence_rad,
    intensity_table,
    range_distance_m,
    returns_by_incidence,
    returns_by_range,
    scan_grid,
    table_distance,
)

LASERS, FIRINGS = 8, 2100


def _scan(range_m: np.ndarray | float, intensity: float = 0.3) -> ScanGrid:
    azimuth = np.linspace(np.pi, -np.pi, FIRINGS, endpoint=False)
    elevation = np.deg2rad(np.linspace(2.0, -12.0, LASERS))[:, None]
    flat = np.cos(elevation) * np.ones(FIRINGS)
    direction = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) * np.ones(FIRINGS)], -1
    )
    shown = np.broadcast_to(range_m, (LASERS, FIRINGS))
    return scan_grid(direction * shown[..., None], np.full((LASERS, FIRINGS), intensity))


def test_a_scan_is_zero_apart_from_itself() -> None:
    scan = _scan(12.0)
    assert hits_differ(scan, scan) == 0.0
    assert range_distance_m(returns_by_range(scan), returns_by_range(scan)) == 0.0
    assert incidence_distance_deg(returns_by_incidence(scan), returns_by_incidence(scan)) == 0.0
    assert table_distance(intensity_table(scan), intensity_table(scan)) == 0.0


def test_returns_that_are_missing_or_farther_are_measured_in_their_units() -> None:
    near, far = _scan(9.0), _scan(22.0)
    # From the step of 8 to 10 m to that of 20 to 25 m, whose upper edges are 15 m apart.
    assert range_distance_m(returns_by_range(near), returns_by_range(far)) == pytest.approx(15.0, abs=5.0)
    shown = np.full((LASERS, FIRINGS), 9.0)
    shown[2] = 0.0
    holed = _scan(shown)
    assert hits_differ(near, holed) == pytest.approx(1.0 / LASERS)
    assert hit_rate_by_laser(holed).tolist() == [1, 1, 0, 1, 1, 1, 1, 1]
    assert table_distance(intensity_table(near), intensity_table(_scan(9.0, 0.5))) == pytest.approx(0.2)


def test_the_ground_is_met_at_the_angle_that_elevation_gives() -> None:
    elevation = np.deg2rad(np.linspace(2.0, -12.0, LASERS))[:, None]
    below = np.where(elevation < -0.01, -1.7 / np.minimum(np.sin(elevation), -1e-3), 0.0)
    found = incidence_rad(_scan(below * np.ones(FIRINGS)))
    expected = np.pi / 2 + elevation
    middle = slice(3, LASERS - 1)  # both neighbours meet the ground, too
    assert np.nanmax(np.abs(found[middle] - expected[middle])) < np.deg2rad(0.5)
    assert np.isnan(found[0]).all() and np.isnan(found[-1]).all()


def test_a_grid_has_the_same_columns_for_any_number_of_firings_and_refuses_other_shapes() -> None:
    assert _scan(5.0).range_m.shape == (LASERS, COLUMNS)
    assert scan_grid(np.zeros((4, 10, 3)), np.zeros((4, 10))).intensity.shape == (4, COLUMNS)
    with pytest.raises(ShapeError, match="found"):
        scan_grid(np.zeros((4, 10, 3)), np.zeros((4, 9)))


def test_an_empty_scan_has_no_distribution() -> None:
    empty = _scan(0.0)
    assert np.isnan(returns_by_range(empty)).all()
    assert np.isnan(table_distance(intensity_table(empty), intensity_table(_scan(9.0))))
