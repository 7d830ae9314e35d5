import math
from functools import partial

import numpy as np
import pytest
import torch

from nvsf_core.errors import ShapeError, StoreError
from nvsf_core.metrics.foreground import masked_image_regions
from nvsf_core.metrics.image import image_metrics, image_part_metrics, missing_share
from nvsf_core.metrics.lpips import load_lpips, lpips_measure
from nvsf_core.metrics.lpips_file import find_weights


def _needs_weights() -> None:
    if find_weights() is None:
        pytest.skip("no LPIPS weights on this machine (NVSF_LPIPS_WEIGHTS)")


def test_lpips_gives_the_published_numbers() -> None:
    _needs_weights()
    lpips = load_lpips()
    assert lpips is not None
    generator = torch.Generator().manual_seed(42)
    first = torch.rand(2, 3, 100, 100, generator=generator)
    second = torch.rand(2, 3, 100, 100, generator=generator)
    found = lpips(first, second)
    assert found.tolist() == pytest.approx([0.102380, 0.093774], abs=2e-6)


def test_lpips_of_equal_images_is_zero() -> None:
    _needs_weights()
    image = np.random.default_rng(0).random((40, 50))
    assert lpips_measure(load_lpips(), image, image).value == 0.0


def test_lpips_without_weights_is_undefined_and_says_how_to_get_it() -> None:
    measure = lpips_measure(None, np.zeros((40, 40)), np.zeros((40, 40)))
    assert math.isnan(measure.value)
    assert "NVSF_LPIPS_WEIGHTS" in measure.reason


def test_a_named_weight_file_must_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NVSF_LPIPS_WEIGHTS", "/nowhere/weights.safetensors")
    with pytest.raises(StoreError, match="unset it"):
        find_weights()


def test_image_error_of_a_known_offset() -> None:
    truth = np.full((20, 20, 3), 100, dtype=np.uint8)
    found = image_metrics(truth + np.uint8(51), truth, np.ones((20, 20), dtype=bool), None)
    assert found["image_psnr_db"].value == pytest.approx(-20 * math.log10(0.2))
    assert found["image_psnr_db"].n_valid == 400


def test_an_unanswered_pixel_is_black_and_counts() -> None:
    truth = np.full((20, 20, 3), 255, dtype=np.uint8)
    predicted = truth.copy()
    predicted[:10] = 0
    found = image_metrics(predicted, truth, np.ones((20, 20), dtype=bool), None)
    assert found["image_psnr_db"].value == pytest.approx(10 * math.log10(2))


def test_pixels_outside_the_recording_do_not_count() -> None:
    truth = np.random.default_rng(0).integers(0, 255, (30, 30, 3)).astype(np.uint8)
    predicted = truth.copy()
    predicted[:5] = 0
    valid = np.ones((30, 30), dtype=bool)
    valid[:5] = False
    found = image_metrics(predicted, truth, valid, None)
    assert found["image_psnr_db"].value == 80.0
    assert found["image_ssim"].value == pytest.approx(1.0)
    empty = image_metrics(predicted, truth, np.zeros((30, 30), dtype=bool), None)
    assert all(math.isnan(measure.value) for measure in empty.values())


def test_a_mask_of_another_size_is_refused() -> None:
    image = np.zeros((20, 20, 3), dtype=np.uint8)
    with pytest.raises(ShapeError):
        image_metrics(image, image, np.ones((10, 20), dtype=bool), None)


def test_pixels_without_an_answer_are_black_where_the_truth_is_seen_and_is_not() -> None:
    truth = np.full((4, 10, 3), 90, dtype=np.uint8)
    truth[3] = 0
    predicted, valid = truth.copy(), np.ones((4, 10), dtype=bool)
    predicted[0], predicted[1, :, 1:], valid[2] = 0, 0, False
    measure = missing_share(predicted, truth, valid)
    assert (measure.value, measure.n_valid) == (0.5, 20)
    assert math.isnan(missing_share(predicted, truth * 0, valid).value)


def test_part_metrics_count_the_chosen_pixels_alone_and_are_absent_without_one() -> None:
    truth = np.full((8, 10, 3), 100, np.uint8)
    shown = truth.copy()
    shown[:, 5:] += 51
    right = np.zeros((8, 10), np.bool_)
    right[:, 5:] = True
    found = image_part_metrics(shown, truth, right)["image_psnr_db"]
    assert found.value == pytest.approx(-20.0 * math.log10(0.2)) and found.n_valid == 40
    assert image_part_metrics(shown, truth, ~right)["image_psnr_db"].value == 80.0
    assert image_part_metrics(shown, truth, right & ~right)["image_psnr_db"].is_absent
    with pytest.raises(ShapeError):
        image_part_metrics(shown[1:], truth, right)


def test_colours_from_0_to_1_are_refused_and_not_divided_by_255_again() -> None:
    half, level = np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 128, np.uint8)
    mask = np.ones((16, 16), np.bool_)
    regions = partial(masked_image_regions, rectangles=mask)
    for measured in (partial(image_metrics, lpips=None), image_part_metrics, missing_share, regions):
        for predicted, truth, name in ((half, level, "predicted"), (level, half, "true")):
            with pytest.raises(ShapeError, match=rf"{name} image as \(H, W, 3\) uint8, found .* float64"):
                measured(predicted, truth, mask)
        with pytest.raises(ShapeError, match=r"found .*16, 16, 4.* uint8"):
            measured(np.zeros((16, 16, 4), np.uint8), np.zeros((16, 16, 4), np.uint8), mask)
        with pytest.raises(ShapeError, match=r"mask .* bool .* found .* uint8"):
            measured(level, level, mask.astype(np.uint8))
