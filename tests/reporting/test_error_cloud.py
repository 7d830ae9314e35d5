import io

import numpy as np
from PIL import Image

from nvsf_core.reporting.error_cloud import WRONG_COLOUR, error_cloud_figure, error_cloud_png


def _pixels(points_m: np.ndarray, error_m: np.ndarray) -> np.ndarray:
    png = error_cloud_png(points_m, error_m, extent_m=10.0, pixels=20)
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def test_errors_above_a_metre_are_red_and_others_grey_the_lighter_the_worse() -> None:
    points_m = np.array(
        [[5.5, 0.5, 0.0], [5.5, 2.5, 0.0], [5.5, 4.5, 0.0], [5.5, 6.5, 0.0], [-5.5, 0.5, 0.0]]
    )
    picture = _pixels(points_m, np.array([0.0, 0.9, 1.1, np.inf, np.nan]))
    ahead = picture[4]
    for column, is_red in ((9, False), (7, False), (5, True), (3, True)):
        assert (tuple(ahead[column]) == WRONG_COLOUR) == is_red
    assert ahead[7, 0] > ahead[9, 0] > 0
    assert tuple(picture[15, 9]) == WRONG_COLOUR
    assert (picture != 0).any(axis=-1).sum() == 5


def test_a_wrong_return_is_not_hidden_by_a_right_one() -> None:
    points_m = np.array([[1.2, 1.2, 0.0], [1.3, 1.3, 3.0], [50.0, 0.0, 0.0]])
    picture = _pixels(points_m, np.array([2.0, 0.0, 9.0]))
    assert (picture != 0).any(axis=-1).sum() == 1
    assert WRONG_COLOUR in {tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()}


def test_without_a_picture_the_report_shows_none() -> None:
    assert error_cloud_figure(None) == ""
    assert "data:image/png" in error_cloud_figure(_png())


def _png() -> bytes:
    return error_cloud_png(np.zeros((1, 3)), np.zeros(1), pixels=4)
