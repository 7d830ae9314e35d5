import math

import pytest

from nvsf_core.metrics.support_pool import Pooled, pool_by_support
from nvsf_core.rendering.rendered import Support


def _row(metric: str, value: float, n_valid: int, support: Support = Support.SEEN) -> dict:
    return {
        "protocol": "image", "metric": metric, "value": value, "n_valid": n_valid, "region": support.region,
    }  # fmt: skip


def test_each_pixel_counts_once_and_decibels_are_pooled_as_mean_squares() -> None:
    rows = [_row("image_psnr_db", 20.0, 100), _row("image_psnr_db", 10.0, 300), _row("image_ssim", 0.5, 1)]
    found = pool_by_support(rows, "image", "image_psnr_db")
    assert list(found) == [Support.SEEN, Support.EXTRAPOLATED, Support.GUESSED]
    assert found[Support.SEEN] == (pytest.approx(-10.0 * math.log10((0.01 + 3 * 0.1) / 4)), 400)


def test_frames_without_a_value_weigh_nothing() -> None:
    rows = [_row("image_ssim", 0.5, 10), _row("image_ssim", math.nan, 0)]
    found = pool_by_support(rows, "image", "image_ssim")
    assert found[Support.SEEN] == Pooled(0.5, 10)
    assert math.isnan(found[Support.GUESSED].value) and found[Support.GUESSED].n_valid == 0
