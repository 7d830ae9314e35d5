import numpy as np
import pytest

from nvsf_core.errors import DataError
from nvsf_core.metrics.trust.drive_distance import DriveCloud, thinned


def _plane(z_m: float = 0.0) -> np.ndarray:
    x, y = np.mgrid[0:10:0.1, 0:10:0.1]
    return np.stack([x.ravel() + 0.05, y.ravel() + 0.05, np.full(x.size, z_m + 0.05)], axis=1)


def test_returns_on_the_recorded_surface_are_not_away_and_those_half_a_metre_off_are() -> None:
    cloud = DriveCloud([_plane()])
    assert cloud.away(_plane()) == 0.0
    assert cloud.away(_plane(0.5)) == 1.0
    assert cloud.away(np.concatenate([_plane()[::2], _plane(0.5)[::2]])) == pytest.approx(0.5, abs=0.01)


def test_the_density_aware_distance_is_zero_on_the_surface_and_grows_with_distance_and_crowding() -> None:
    cloud = DriveCloud([_plane()])
    on, near, far = (cloud.density_aware(_plane(z_m)) for z_m in (0.0, 0.1, 0.5))
    assert on == pytest.approx(0.0, abs=1e-6)
    assert near == pytest.approx(1.0 - np.exp(-0.1 / 0.22), abs=1e-3)
    assert on < near < far < 1.0
    # Two layers of points share their nearest recorded ones.
    crowded = cloud.density_aware(np.concatenate([_plane(0.1), _plane(-0.1)]))
    assert crowded > near + 0.2


def test_a_scan_without_returns_is_as_far_as_can_be_and_an_empty_drive_is_refused() -> None:
    cloud = DriveCloud([_plane()])
    assert cloud.away(np.zeros((0, 3))) == cloud.density_aware(np.zeros((0, 3))) == 1.0
    with pytest.raises(DataError, match="found none"):
        DriveCloud([np.zeros((0, 3))])


def test_a_thinned_cloud_has_a_point_a_cell() -> None:
    assert len(thinned(np.concatenate([_plane(), _plane() + 0.01]))) == len(_plane())
