"""The figures of docs/trust.md."""

import math
from pathlib import Path

import pytest

from benchmarks.views.trust import ScoredView, orders, rank_correlation, support_table
from nvsf_core.metrics.trust.cues import PROTOCOL, SCORE

COST = {"render_seconds": 1.0, "train_seconds": 1.0, "parameters": 1, "model_mb": 1.0, "unit": "1"}


def _view(score: float, psnr_db: float) -> ScoredView:
    return ScoredView("street", "v", "images", "as recorded", score, {"image_psnr_db": psnr_db})


def _row(view: str, protocol: str, metric: str, value: float, region: str = "all", n_valid: int = 1) -> dict:
    sensor = "image_00" if "image" in metric or protocol == PROTOCOL else "lidar"
    return {
        "scene": "street", "split": view, "protocol": protocol, "metric": metric, "value": value, "seed": 0,
        "region": region, "n_valid": n_valid, "sensor": sensor, "recipe": "quick", "frame": 1, **COST,
    }  # fmt: skip


def test_views_in_the_order_of_their_errors_correlate_fully_whichever_way_the_metric_rises() -> None:
    views = [_view(0.1, 28.0), _view(0.2, 26.0), _view(0.3, 25.0), _view(0.4, math.nan)]
    assert rank_correlation(views, "image_psnr_db") == (3, pytest.approx(1.0))
    swapped = [_view(0.1, 25.0), _view(0.2, 26.0), _view(0.3, 28.0)]
    assert rank_correlation(swapped, "image_psnr_db") == (3, pytest.approx(-1.0))
    assert math.isnan(rank_correlation(views[:2], "image_psnr_db")[1])


def test_errors_by_support_are_pooled_over_pixels_not_over_images() -> None:
    rows = [
        _row("a", "image", "image_psnr_db", 20.0, "support_seen", 100),
        _row("b", "image", "image_psnr_db", 10.0, "support_seen", 300),
        _row("a", "raw", "f_score", 0.9, "support_guessed", 10),
        _row("b", "raw", "f_score", 0.4, "support_guessed", 40),
    ]
    table = support_table(rows)
    assert "| street | images | PSNR dB | 11.1 (100.0%) | – (0.0%) | – (0.0%) |" in table
    assert "| street | scans | F | – (0.0%) | – (0.0%) | 0.500 (100.0%) |" in table


def test_the_page_orders_views_by_score_and_holds_the_generated_parts(repo: Path) -> None:
    rows = [_row(view, PROTOCOL, SCORE, score) for view, score in (("far", 0.3), ("near", 0.1), ("mid", 0.2))]
    errors = (("far", 20.0), ("near", 27.0), ("mid", 24.0))
    rows += [_row(view, "image", "image_psnr_db", value) for view, value in errors]
    text = orders(rows, "From here.")
    assert text.index("| near |") < text.index("| mid |") < text.index("| far |")
    assert "| images: views asked for, street | 3 | PSNR dB | 1.00 |" in text
    page = (repo / "docs" / "trust.md").read_text()
    assert all(page.count(f"<!-- {name} -->") == 1 for name in ("orders", "baselines", "support"))
