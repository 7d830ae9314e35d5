import math

import numpy as np
import pytest

from nvsf_core.metrics.foreground import (
    BACKGROUND,
    FOREGROUND,
    image_regions,
    lidar4d_regions,
    masked_image_regions,
    masked_range_regions,
    masked_regions,
)
from nvsf_core.metrics.protocols import PanoImage, RenderedRays, Scan, lidar4d
from nvsf_core.sensors.linear_pano import LinearPano

PANO = LinearPano(height=16, width=64, reference_quirks=True)
BOX = np.diag([2.0, 4.0, 2.0, 1.0])[None].copy()
BOX[0, :3, 3] = (8.0, 0.0, -1.0)
NONE = np.zeros((0, 4, 4))


def _scan(object_shift_m: float = 0.0, seed: int = 0) -> Scan:
    """A wall of points around the sensor at 20 m, and an object of 500 points in the box."""
    rng = np.random.default_rng(seed)
    azimuth = np.concatenate([rng.uniform(0.5, 5.8, 900)])
    wall = np.stack([20 * np.cos(azimuth), 20 * np.sin(azimuth), rng.uniform(-3, 0, 900)], axis=1)
    thing = rng.uniform([7.2, -1.8, -1.9], [7.4, 1.8, -0.1], (500, 3))
    thing[:, 0] += object_shift_m
    points = np.concatenate([wall, thing]).astype(np.float32)
    laser = np.arange(1400).astype(np.int16) % 8
    return Scan(points_m=points, intensity=np.full(1400, 0.5, np.float32), laser=laser)


def _rays(scan: Scan) -> RenderedRays:
    return RenderedRays(range_m=np.linalg.norm(scan.points_m, axis=1), intensity=scan.intensity)


def test_a_perfect_answer_is_perfect_in_both_regions_and_they_share_all_returns() -> None:
    scan = _scan()
    found = masked_regions(scan, _rays(scan), scan, _rays(scan), (8, 2000), BOX)
    for region in (FOREGROUND, BACKGROUND):
        assert found[region]["chamfer_m2"].value == 0.0
        assert found[region]["range_abs_error_p90_m"].value == 0.0
        assert found[region]["hit_accuracy"].value == 1.0
    rays = [found[region]["range_missing"].n_valid for region in (FOREGROUND, BACKGROUND)]
    assert rays == [500, 900]
    cells = [found[region]["hit_accuracy"].n_valid for region in (FOREGROUND, BACKGROUND)]
    assert sum(cells) == 8 * 2000


def test_masked_foreground_sees_the_object_alone_and_background_the_rest() -> None:
    truth, moved = _scan(), _scan(object_shift_m=0.25)
    found = masked_regions(moved, _rays(moved), truth, _rays(truth), (8, 2000), BOX)
    assert 0.2 < found[FOREGROUND]["range_abs_error_median_m"].value < 0.26
    assert found[FOREGROUND]["chamfer_m2"].value > 0.01
    assert found[BACKGROUND]["range_abs_error_p90_m"].value == 0.0
    assert found[BACKGROUND]["chamfer_m2"].value == 0.0


def test_a_return_just_beside_its_box_is_held_against_the_prediction_and_one_far_off_is_missed() -> None:
    truth = _scan()
    beside, gone = _scan(object_shift_m=-0.45), _scan(object_shift_m=-2.0)
    near = masked_regions(beside, _rays(beside), truth, _rays(truth), (8, 2000), BOX)[FOREGROUND]
    assert near["chamfer_m2"].n_valid > 900
    lost = masked_regions(gone, _rays(gone), truth, _rays(truth), (8, 2000), BOX)[FOREGROUND]
    assert lost["chamfer_m2"].n_valid == 500
    assert math.isnan(lost["chamfer_m2"].value)
    assert lost["f_score"].value == 0.0
    assert not lost["chamfer_m2"].is_absent, "a lost object is the model's fault"
    assert lost["range_abs_error_median_m"].value > 1.9


def test_a_frame_without_a_moving_object_has_no_foreground_and_says_why() -> None:
    scan = _scan()
    found = masked_regions(scan, _rays(scan), scan, _rays(scan), (8, 2000), NONE)
    assert {m.is_absent for m in found[FOREGROUND].values()} == {True}
    assert all(math.isnan(m.value) and m.n_valid == 0 for m in found[FOREGROUND].values())
    assert "annotated" in found[FOREGROUND]["chamfer_m2"].reason
    assert found[BACKGROUND]["range_missing"].n_valid == 1400
    empty = BOX.copy()
    empty[0, 2, 3] = 30.0
    missed = masked_regions(scan, _rays(scan), scan, _rays(scan), (8, 2000), empty)[FOREGROUND]
    assert "no recorded return" in missed["f_score"].reason


def _pano(scan: Scan) -> PanoImage:
    range_m, intensity = PANO.project(scan.points_m, scan.intensity)
    return PanoImage(range_m=range_m, intensity=intensity, hit=(range_m > 0).astype(np.float32))


def test_published_foreground_dilutes_the_error_by_all_pixels_that_are_black_on_both_sides() -> None:
    truth, moved = _pano(_scan()), _pano(_scan(object_shift_m=0.25))
    whole = lidar4d(moved, truth, PANO, None)
    regions = lidar4d_regions(moved, truth, PANO, BOX, None)
    assert regions[FOREGROUND]["range_rmse_m"].n_valid == whole["range_rmse_m"].n_valid
    assert regions[FOREGROUND]["range_psnr_db"].value > 35.0
    assert not any("lpips" in name for name in regions[BACKGROUND])
    assert "range_lpips_alex" in regions[FOREGROUND]


def test_masked_range_error_is_of_the_objects_own_pixels_and_counts_what_one_side_leaves_empty() -> None:
    truth, moved = _pano(_scan()), _pano(_scan(object_shift_m=0.25))
    found = masked_range_regions(moved, truth, PANO, BOX)
    published = lidar4d_regions(moved, truth, PANO, BOX, None)[FOREGROUND]["range_rmse_m"]
    assert found[FOREGROUND]["range_rmse_m"].n_valid < 60
    assert found[FOREGROUND]["range_rmse_m"].value > 3 * published.value
    assert found[BACKGROUND]["range_rmse_m"].value == 0.0
    assert sum(regions["range_rmse_m"].n_valid for regions in found.values()) == truth.range_m.size
    # The object is not expected: every one of its pixels is off by its whole range.
    ranges, lost = truth.range_m, truth.range_m.copy()
    lost[(ranges > 0) & (ranges < 9.0)] = 0.0
    empty = PanoImage(range_m=lost, intensity=truth.intensity, hit=truth.hit)
    unsure = PanoImage(range_m=ranges, intensity=truth.intensity, hit=0.4 * truth.hit)
    for missed in (empty, unsure):
        error = masked_range_regions(missed, truth, PANO, BOX)[FOREGROUND]["range_rmse_m"]
        assert 7.2 < error.value < 9.0


def test_masked_range_error_is_nan_on_nothing_where_no_pixel_counts() -> None:
    truth = _pano(_scan())
    away = BOX.copy()
    away[0, 2, 3] = 30.0
    for boxes, reason in ((NONE, "annotated"), (away, "no recorded return")):
        found = masked_range_regions(truth, truth, PANO, boxes)
        absent = found[FOREGROUND]["range_rmse_m"]
        assert math.isnan(absent.value) and absent.n_valid == 0 and absent.is_absent
        assert reason in absent.reason
        assert found[BACKGROUND]["range_rmse_m"].n_valid == truth.range_m.size


def test_published_regions_of_an_empty_truth_are_explained() -> None:
    truth = _pano(_scan())
    assert lidar4d_regions(truth, truth, PANO, NONE, None)[FOREGROUND]["range_rmse_m"].is_absent
    away = BOX.copy()
    away[0, 2, 3] = 30.0
    found = lidar4d_regions(truth, truth, PANO, away, None)[FOREGROUND]
    assert found["chamfer_m2"].is_absent
    assert found["range_rmse_m"].value == 0.0, "as published: two black images are equal"


def test_masked_psnr_is_of_the_regions_own_pixels() -> None:
    truth = np.full((20, 24, 3), 100, np.uint8)
    predicted = truth.copy()
    predicted[5:15, 6:16] += 51
    inside = np.zeros((20, 24), dtype=bool)
    inside[5:15, 6:16] = True
    valid = np.ones((20, 24), dtype=bool)
    found = masked_image_regions(predicted, truth, valid, inside)
    assert found[FOREGROUND]["image_psnr_db"].value == pytest.approx(-20 * math.log10(0.2))
    assert found[FOREGROUND]["image_psnr_db"].n_valid == 100
    assert found[BACKGROUND]["image_psnr_db"].value == 80.0
    published = image_regions(predicted, truth, valid, inside, None)
    diluted = -10 * math.log10(0.04 * 100 / 480)
    assert published[FOREGROUND]["image_psnr_db"].value == pytest.approx(diluted)
    nothing = image_regions(predicted, truth, valid, np.zeros_like(inside), None)
    assert nothing[FOREGROUND]["image_psnr_db"].is_absent
    assert not nothing[BACKGROUND]["image_psnr_db"].is_absent
