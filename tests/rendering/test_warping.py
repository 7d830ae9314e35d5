"""Bicubic values between an image's pixels."""

import pytest
import torch
from torch import Tensor

from nvsf_core.rendering.warping import sample, sample_cubic

HEIGHT, WIDTH = 12, 16


def grid_of(places_px: Tensor) -> Tensor:
    """Places (n, 2), column and row in pixels from the first one's centre, in grid_sample's coordinates."""
    sides = torch.tensor([WIDTH, HEIGHT], dtype=torch.float32)
    return ((places_px + 0.5) * 2.0 / sides - 1.0)[None]


def image_of(colour: Tensor) -> Tensor:
    """An image (4, h, w) of one colour channel (h, w), three times, whose pixels all show something."""
    return torch.cat([colour.expand(3, -1, -1), torch.ones(1, HEIGHT, WIDTH)])


@pytest.fixture
def places_px() -> Tensor:
    """Places at least two pixels away from the border."""
    inner = torch.rand(500, 2, generator=torch.Generator().manual_seed(0))
    return 2.0 + inner * (torch.tensor([WIDTH, HEIGHT]) - 5.0)


def test_a_paraboloid_is_repeated_where_bilinear_values_are_not(places_px: Tensor) -> None:
    row, column = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")

    def height(u: Tensor, v: Tensor) -> Tensor:
        return 0.02 * u**2 - 0.03 * v**2 + 0.01 * u * v + 0.1 * u

    image, grid = image_of(height(column, row)), grid_of(places_px)
    truth = height(*places_px.T)
    torch.testing.assert_close(sample_cubic(image, grid)[0, 0], truth, atol=1e-4, rtol=0.0)
    assert (sample(image, grid)[0, 0] - truth).abs().max() > 5e-3


def test_at_a_pixel_s_centre_its_own_value_is_found_at_the_border_too() -> None:
    colour = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    row, column = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    places = torch.stack([column, row], dim=-1).reshape(-1, 2).float()
    found = sample_cubic(image_of(colour), grid_of(places))[0, 0]
    torch.testing.assert_close(found, colour.flatten(), atol=1e-4, rtol=0.0)


def test_beside_a_pixel_that_shows_nothing_values_are_bilinear(places_px: Tensor) -> None:
    image = image_of(torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2)))
    image[:, :, 8] = 0.0
    grid = grid_of(places_px)
    cubic, bilinear = sample_cubic(image, grid)[0, 0], sample(image, grid)[0, 0]
    is_beside = (places_px[:, 0] - 8.0).abs() < 1.9
    torch.testing.assert_close(cubic[is_beside], bilinear[is_beside])
    far = (places_px[:, 0] - 8.0).abs() > 2.0
    assert (cubic - bilinear)[far].abs().max() > 0.01
