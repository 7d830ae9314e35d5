"""Laws of the pixels of a step."""

from dataclasses import replace

import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.recipe.paper import PaperSampling
from nvsf_core.sampling.error_map import ErrorMap
from nvsf_core.sampling.patches import patch_pixels, uniform_corners
from nvsf_core.sampling.pixels import sample_lidar_pixels, sample_pixels, uniform_pixels

SHAPE = (6, 20)
SAMPLING = PaperSampling(rays=64)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def spiked() -> ErrorMap:
    """All of the error in the left half."""
    error_map = ErrorMap(1, *SHAPE, 2)
    error_map.errors[0, :, :5] = 1e6
    return error_map


def test_a_patch_is_its_corner_and_what_follows() -> None:
    rows, columns = patch_pixels(torch.tensor([1]), torch.tensor([3]), (2, 3), SHAPE)
    assert rows.tolist() == [[[1, 1, 1], [2, 2, 2]]]
    assert columns.tolist() == [[[3, 4, 5], [3, 4, 5]]]


def test_a_patch_at_the_edge_is_moved_in() -> None:
    corner = torch.tensor([5]), torch.tensor([18])
    rows, columns = patch_pixels(*corner, (2, 4), SHAPE)
    assert rows[0, :, 0].tolist() == [4, 5] and columns[0, 0].tolist() == [16, 17, 18, 19]


def test_even_corners_reach_every_place_of_the_image() -> None:
    rows, columns = uniform_corners(SHAPE, (2, 8), 2000, generator())
    assert rows.unique().tolist() == list(range(5))
    assert columns.unique().tolist() == list(range(13))
    with pytest.raises(ShapeError):
        uniform_corners(SHAPE, (2, 21), 1, generator())


def test_even_pixels_reach_the_whole_image_or_only_what_shows() -> None:
    rows, columns = uniform_pixels(torch.ones(3, 4, dtype=torch.bool), 500, generator())
    assert len((rows * 4 + columns).unique()) == 12
    is_drawable = torch.zeros(3, 4, dtype=torch.bool)
    is_drawable[1, 2] = is_drawable[2, 3] = True
    rows, columns = uniform_pixels(is_drawable, 50, generator())
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == {(1, 2), (2, 3)}
    with pytest.raises(ShapeError):
        uniform_pixels(torch.zeros(3, 4, dtype=torch.bool), 1, generator())


@pytest.mark.parametrize("heuristic", [False, True])
@pytest.mark.parametrize("patches", [None, (2, 8)])
def test_heuristic_and_patches_are_switches_of_their_own(heuristic: bool, patches) -> None:
    sampling = replace(SAMPLING, heuristic=heuristic, patches=patches, rays=96)
    error_map = ErrorMap(1, 12, 80, 2)
    error_map.errors[0, :, :20] = 1e6
    first = sample_lidar_pixels(sampling, 0, 0, error_map, generator())
    assert first.patch is None
    assert (first.columns >= 40).any()
    second = sample_lidar_pixels(sampling, 1, 0, error_map, generator())
    assert second.patch == patches
    assert len(second.rows) == len(second.columns) == 96
    corners = second.columns[:: 16 if patches else 1]
    assert bool((corners >= 40).any()) is not heuristic
    if patches:
        assert second.columns.view(-1, *patches).diff(dim=2).eq(1).all()
        assert second.rows.view(-1, *patches).diff(dim=1).eq(1).all()


def test_camera_pixels_follow_the_map_in_second_epochs_only() -> None:
    sampling = replace(SAMPLING, rays=12)
    assert (sample_pixels(sampling, 1, 0, spiked(), generator()).columns < 10).all()
    assert (sample_pixels(sampling, 2, 0, spiked(), generator()).columns >= 10).any()


def test_fewer_rays_than_a_patch_still_make_one() -> None:
    drawn = sample_lidar_pixels(replace(SAMPLING, rays=4), 1, 0, spiked(), generator())
    assert len(drawn.rows) == 16
