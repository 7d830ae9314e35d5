import math

import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.point_cloud import point_cloud_metrics


def _brute(p: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    d2 = ((p[:, None].astype(float) - t[None].astype(float)) ** 2).sum(-1)
    to_t, to_p = d2.min(1), d2.min(0)
    precision, recall = (to_t < 0.05).mean(), (to_p < 0.05).mean()
    return to_t.mean() + to_p.mean(), 2 * precision * recall / (precision + recall)


def test_equals_the_definition_and_is_not_one_sided() -> None:
    rng = np.random.default_rng(0)
    p = rng.random((200, 3)).astype(np.float32) * 2
    t = np.concatenate([p[:150] + 0.05, rng.random((60, 3)).astype(np.float32) * 4])
    chamfer, f_score = _brute(p, t)
    found = point_cloud_metrics(p, t)
    assert found["chamfer_m2"].value == pytest.approx(chamfer, rel=1e-9)
    assert found["f_score"].value == pytest.approx(f_score)
    assert found["chamfer_m2"].n_valid == 410
    back = point_cloud_metrics(t, p)
    assert back["chamfer_m2"].value == pytest.approx(chamfer, rel=1e-9)


def test_the_threshold_is_on_the_squared_distance() -> None:
    origin = np.zeros((1, 3))
    assert point_cloud_metrics(np.array([[0.22, 0, 0]]), origin)["f_score"].value == 1.0
    assert point_cloud_metrics(np.array([[0.23, 0, 0]]), origin)["f_score"].value == 0.0


def test_far_from_the_origin_nothing_is_lost() -> None:
    rng = np.random.default_rng(1)
    p, t = rng.random((100, 3)) * 10, rng.random((100, 3)) * 10
    near = point_cloud_metrics(p, t)["chamfer_m2"].value
    assert point_cloud_metrics(p + 5e6, t + 5e6)["chamfer_m2"].value == pytest.approx(near, rel=1e-6)


def test_empty_clouds_have_no_distance_and_score_zero() -> None:
    nothing, one = np.zeros((0, 3)), np.zeros((1, 3))
    for p, t in ((nothing, one), (one, nothing)):
        found = point_cloud_metrics(p, t)
        assert math.isnan(found["chamfer_m2"].value)
        assert "no points" in found["chamfer_m2"].reason
        assert found["f_score"].value == 0.0
    assert math.isnan(point_cloud_metrics(nothing, nothing)["f_score"].value)


def test_broken_points_are_counted_not_dropped() -> None:
    found = point_cloud_metrics(np.array([[np.nan, 0, 0], [0, 0, 0]]), np.zeros((1, 3)))
    assert math.isnan(found["chamfer_m2"].value)
    assert "1 of 6" in found["chamfer_m2"].reason


@pytest.mark.parametrize("columns", [2, 4])
def test_rows_with_an_intensity_or_without_a_height_are_refused(columns: int) -> None:
    right, wrong = np.zeros((5, 3)), np.zeros((5, columns))
    for p, t in ((wrong, wrong), (wrong, right), (right, wrong)):
        with pytest.raises(ShapeError, match=rf"cloud as \(N, 3\) .* found \(5, {columns}\)"):
            point_cloud_metrics(p, t)
