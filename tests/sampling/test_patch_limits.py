"""Which patches fit into an image, and which epochs sample heuristically."""

import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.sampling.patches import patch_pixels, require_patch_fits, uniform_corners
from nvsf_core.sampling.pixels import is_second_epoch


@pytest.mark.parametrize("patch", [(1, 1), (3, 5), (3, 1), (1, 5)])
def test_patches_up_to_the_image_fit(patch) -> None:
    require_patch_fits((3, 5), patch)


@pytest.mark.parametrize("patch", [(0, 1), (1, 0), (4, 1), (1, 6), (-1, 2)])
def test_empty_patches_and_larger_ones_than_the_image_are_refused(patch) -> None:
    with pytest.raises(ShapeError, match="patches"):
        require_patch_fits((3, 5), patch)
    with pytest.raises(ShapeError):
        uniform_corners((3, 5), patch, 1, torch.Generator())
    with pytest.raises(ShapeError):
        patch_pixels(torch.tensor([0]), torch.tensor([0]), patch, (3, 5))


def test_a_patch_as_large_as_the_image_has_one_corner() -> None:
    rows, columns = uniform_corners((3, 5), (3, 5), 7, torch.Generator().manual_seed(0))
    assert rows.tolist() == columns.tolist() == [0] * 7
    assert rows.dtype == columns.dtype == torch.int64


def test_a_patch_in_the_last_corner_is_moved_in_by_rows_and_columns() -> None:
    rows, columns = patch_pixels(torch.tensor([2]), torch.tensor([4]), (2, 2), (3, 5))
    assert rows.tolist() == [[[1, 1], [2, 2]]]
    assert columns.tolist() == [[[3, 4], [3, 4]]]


def test_every_second_epoch_is_heuristic_from_the_second_on() -> None:
    assert [is_second_epoch(epoch) for epoch in range(5)] == [False, True, False, True, False]
