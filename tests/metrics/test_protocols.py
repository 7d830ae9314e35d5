import math

import numpy as np
import pytest

from nvsf_core.metrics.protocols import PanoImage, RenderedRays, Scan, lidar4d, project_scan, raw
from nvsf_core.sensors.linear_pano import LinearPano

PANO = LinearPano(height=16, width=64, reference_quirks=True)


def _scan(n: int = 800, seed: int = 0) -> Scan:
    """A bumpy room around the sensor, 4 lasers, within the pano's field of view."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(-3.0, 3.0, n)
    elevation = np.deg2rad(rng.uniform(-22, 0, n))
    range_m = 10 + 3 * np.cos(3 * azimuth)
    flat = range_m * np.cos(elevation)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)], 1)
    return Scan(
        points_m=points.astype(np.float32),
        intensity=rng.random(n).astype(np.float32),
        laser=rng.integers(0, 4, n).astype(np.int16),
    )


def _rays(scan: Scan) -> RenderedRays:
    return RenderedRays(range_m=np.linalg.norm(scan.points_m, axis=1), intensity=scan.intensity)


def test_the_recorded_scan_itself_is_a_perfect_answer() -> None:
    scan = _scan()
    truth = project_scan(PANO, scan)
    found = lidar4d(truth, truth, PANO, None)
    assert found["chamfer_m2"].value == 0.0
    assert found["f_score"].value == 1.0
    assert found["range_psnr_db"].value == 80.0
    assert found["hit_accuracy"].value == 1.0
    own = raw(scan, _rays(scan), scan, _rays(scan), (4, 2000))
    assert own["range_abs_error_p90_m"].value == 0.0
    assert own["hit_accuracy"].value == 1.0
    assert own["chamfer_m2"].value == 0.0


def test_the_prediction_is_masked_by_its_own_hits_before_anything_is_measured() -> None:
    truth = project_scan(PANO, _scan())
    ghost = PanoImage(range_m=np.full((16, 64), 40.0), intensity=np.ones((16, 64)), hit=truth.hit * 0.4)
    found = lidar4d(ghost, truth, PANO, None)
    assert math.isnan(found["chamfer_m2"].value)
    assert found["f_score"].value == 0.0
    # All empty: every true range counts as an error of itself.
    expected = math.sqrt(np.mean(truth.range_m.astype(float) ** 2))
    assert found["range_rmse_m"].value == pytest.approx(expected, rel=1e-4)
    assert ghost.range_m.min() == 40.0


def test_points_of_the_lidar4d_protocol_are_the_panos_and_not_the_scans() -> None:
    scan = _scan(5000)
    truth = project_scan(PANO, scan)
    n_points = 2 * int(np.count_nonzero(truth.range_m))
    assert lidar4d(truth, truth, PANO, None)["chamfer_m2"].n_valid == n_points
    assert raw(scan, _rays(scan), scan, _rays(scan), (4, 2000))["chamfer_m2"].n_valid == 10000


def test_returns_beyond_80_m_count_on_neither_side() -> None:
    scan = _scan()
    far = Scan(
        points_m=np.concatenate([scan.points_m, [[0.0, 90.0, 0.0]]]).astype(np.float32),
        intensity=np.append(scan.intensity, 1.0),
        laser=np.append(scan.laser, 0),
    )
    rays, rendered = _rays(far), _rays(far)
    rendered.range_m[-1] = np.inf
    found = raw(scan, rendered, far, rays, (4, 2000))
    assert found["range_missing"].value == 0.0
    assert found["range_missing"].n_valid == 800
    assert found["chamfer_m2"].value == 0.0
    assert found["hit_accuracy"].value == 1.0


def test_an_empty_prediction_is_measured_and_not_a_crash() -> None:
    scan = _scan()
    nothing = Scan(points_m=np.zeros((0, 3), np.float32), intensity=np.zeros(0), laser=np.zeros(0, np.int16))
    silent = RenderedRays(range_m=np.full(800, np.inf), intensity=np.zeros(800))
    found = raw(nothing, silent, scan, _rays(scan), (4, 2000))
    assert found["range_missing"].value == 1.0
    assert math.isnan(found["intensity_rmse"].value)
    empty = lidar4d(project_scan(PANO, nothing), project_scan(PANO, scan), PANO, None)
    assert empty["f_score"].value == 0.0
