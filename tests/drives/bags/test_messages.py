"""Messages of bags whose sizes do not fit their bytes are refused by name, before anything is allocated."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nvsf_core.drives.bags.messages import cloud_columns, image_rgb
from nvsf_core.drives.bags.transforms import pose_of
from nvsf_core.errors import DataError

POINTS = np.arange(12, dtype="<f4").reshape(4, 3)


def _cloud(**changed: Any) -> SimpleNamespace:
    fields = [SimpleNamespace(name=name, datatype=7, count=1, offset=4 * k) for k, name in enumerate("xyz")]
    facts = {"width": 2, "height": 2, "point_step": 12, "row_step": 24, "data": POINTS.view(np.uint8).ravel()}
    return SimpleNamespace(fields=fields, is_bigendian=False, **(facts | changed))


def _image(height: int, width: int, step: int) -> SimpleNamespace:
    data = np.zeros(height * step, np.uint8)
    return SimpleNamespace(encoding="bgr8", height=height, width=width, step=step, data=data)


@pytest.mark.parametrize("shape", [{}, {"width": 4, "height": 1, "row_step": 0}])
def test_rows_of_points_are_read_one_after_the_other(shape: dict[str, int]) -> None:
    found = cloud_columns(_cloud(**shape), "/points")
    assert np.array_equal(np.stack([found[name] for name in "xyz"], axis=1), POINTS)


@pytest.mark.parametrize(
    "changed",
    [
        {"height": 2**32 - 1, "width": 1, "row_step": 0},
        {"height": 2**32 - 1, "width": 2**32 - 1},
        {"height": 3},
        {"row_step": 12},
        {"point_step": 0},
        {"width": 5, "height": 1, "row_step": 0},
    ],
)
def test_a_cloud_of_more_points_than_bytes_is_refused(changed: dict[str, int]) -> None:
    with pytest.raises(DataError, match=r"/points: expected .* points of .* bytes, found 48 bytes"):
        cloud_columns(_cloud(**changed), "/points")


def test_four_billion_rows_without_points_are_an_empty_cloud() -> None:
    found = cloud_columns(_cloud(height=2**32 - 1, width=0, row_step=0), "/points")
    assert [len(found[name]) for name in "xyz"] == [0, 0, 0]


def test_rows_may_be_padded() -> None:
    padded = np.zeros((2, 40), np.uint8)
    padded[:, :24] = POINTS.view(np.uint8).reshape(2, 24)
    found = cloud_columns(_cloud(row_step=40, data=padded.ravel()), "/points")
    assert np.array_equal(np.stack([found[name] for name in "xyz"], axis=1), POINTS)


@pytest.mark.parametrize(("height", "width", "step"), [(0, 4, 12), (3, 0, 12), (3, 5, 12)])
def test_an_image_without_pixels_or_with_short_rows_is_refused(height: int, width: int, step: int) -> None:
    with pytest.raises(DataError, match=r"/image: expected .* rows of .* pixels"):
        image_rgb(_image(height, width, step), "/image", None)


@pytest.mark.parametrize("x_m", [np.nan, np.inf, 1e12])
def test_a_transform_to_nowhere_is_refused(x_m: float) -> None:
    upright = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    with pytest.raises(DataError, match="expected a place within"):
        pose_of(SimpleNamespace(x=x_m, y=0.0, z=0.0), upright)
    assert pose_of(SimpleNamespace(x=5.0, y=0.0, z=0.0), upright)[0, 3] == 5.0
