import math

import numpy as np
import pytest

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.hit import hit_cell_metrics, hit_cells, hit_columns, hit_image_metrics


def _on_ring(azimuth_deg: np.ndarray) -> np.ndarray:
    angle = np.deg2rad(azimuth_deg)
    return np.stack([10 * np.cos(angle), 10 * np.sin(angle), np.zeros_like(angle)], axis=1)


def test_probability_is_cut_at_a_half() -> None:
    found = hit_image_metrics(np.array([0.9, 0.6, 0.4, 0.1]), np.array([True, False, True, False]))
    assert found["hit_accuracy"].value == 0.5
    assert found["hit_f_score"].value == pytest.approx(0.5)
    assert found["hit_rmse"].value == pytest.approx(math.sqrt((0.01 + 0.36 + 0.36 + 0.01) / 4))


def test_no_hit_on_either_side_has_no_f_score() -> None:
    found = hit_image_metrics(np.zeros(4), np.zeros(4, dtype=bool))
    assert found["hit_accuracy"].value == 1.0
    assert math.isnan(found["hit_f_score"].value)


def test_a_range_image_is_no_truth_of_hits() -> None:
    with pytest.raises(ShapeError, match="true hits as bool, found float64; of a range image: range_m > 0"):
        hit_image_metrics(np.array([0.9, 0.6]), np.array([12.3, 0.0]))


def test_every_cell_is_018_degrees_and_the_seam_stays_inside() -> None:
    centres = (np.arange(2000) + 0.5) * 0.18
    cells = hit_cells(_on_ring(centres), np.ones(2000, dtype=np.int16), (2, 2000))
    assert cells[1].all()
    assert not cells[0].any()
    seam = hit_cells(np.array([[1.0, -1e-30, 0.0]], dtype=np.float32), np.zeros(1, dtype=int), (1, 2000))
    assert seam.sum() == 1


def test_a_missing_turn_quarter_costs_a_quarter() -> None:
    truth = _on_ring((np.arange(2000) + 0.5) * 0.18)
    laser = np.zeros(2000, dtype=np.int16)
    found = hit_cell_metrics((truth[500:], laser[500:]), (truth, laser), shape=(4, 2000))
    assert found["hit_accuracy"].value == pytest.approx(1 - 500 / 8000)
    assert found["hit_accuracy"].n_valid == 8000


def test_unknown_lasers_have_no_cells() -> None:
    points = _on_ring(np.array([10.0]))
    unknown = hit_cell_metrics((points, np.array([0])), (points, np.array([-1])), shape=(1, 2000))
    assert math.isnan(unknown["hit_accuracy"].value)
    assert "1 returns is unknown" in unknown["hit_accuracy"].reason
    more = hit_cell_metrics((points, np.array([7])), (points, np.array([0])), shape=(4, 2000))
    assert "the sensor has 4" in more["hit_accuracy"].reason


@pytest.mark.parametrize(
    ("firings", "columns"),
    [(0, 2000), (2090, 2000), (1800, 1000), (1050, 1000), (500, 500), (499, 250), (10, 125)],
)
def test_no_firing_step_is_wider_than_a_column(firings: int, columns: int) -> None:
    assert hit_columns(firings) == columns
