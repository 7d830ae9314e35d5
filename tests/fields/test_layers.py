"""Small networks: their sizes, their initial weights, and the errors of their specifications."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from nvsf_core.encodings.directions import frequency_encode
from nvsf_core.fields.flow import applied
from nvsf_core.fields.layers import Density, Head, bias_free, network
from nvsf_core.kernels.encodings.hash_grid import grid_layout
from nvsf_core.recipe.paper import HeadsSpec, ReferenceQuirks
from nvsf_core.recipe.residual import FieldSpec


def _seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize(("start", "bounds"), [("xavier", (0.5, 0.5)), ("kaiming", (0.5, 1 / math.sqrt(20)))])
def test_networks_without_biases_start_uniform_within_their_bound(start, bounds) -> None:
    # sqrt(6 / (4 + 20)) = sqrt(6 / (20 + 4)) = 0.5, and 1 / sqrt(4) = 0.5.
    made = bias_free((4, 20, 4), _seeded(), start)
    assert [type(layer) for layer in made] == [nn.Linear, nn.ReLU, nn.Linear]
    for layer, bound in zip((made[0], made[2]), bounds, strict=True):
        assert layer.bias is None
        assert 0.8 * bound < float(layer.weight.detach().abs().max()) <= bound


def test_networks_use_the_given_generator_only() -> None:
    before = torch.get_rng_state()
    first, again = (bias_free((3, 5, 2), _seeded()).state_dict() for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_corrections_are_exactly_zero_before_training_and_the_rest_is_not() -> None:
    made = network((3, 16, 4), _seeded(), zero_outputs=2)
    out = made(torch.randn(50, 3, generator=_seeded()))
    assert out.shape == (50, 4)
    assert (out[:, :2] == 0.0).all() and (out[:, 2:].abs().amax(dim=0) > 0.0).all()


def test_a_head_gives_probabilities_and_broadcasts_directions_over_samples() -> None:
    spec = HeadsSpec()
    head = Head(6 * spec.lidar_frequencies, 1, spec, _seeded())
    direction = nn.functional.normalize(torch.randn(6, 1, 3, generator=_seeded()), dim=-1)
    geometry = torch.randn(6, 4, spec.geometry_features, generator=_seeded())
    angles = frequency_encode(0.5 * (direction + 1.0), spec.lidar_frequencies)
    assert angles.shape == (6, 1, 6 * spec.lidar_frequencies)
    found = head(angles, geometry)
    assert found.shape == (6, 4, 1) and ((found > 0.0) & (found < 1.0)).all()
    torch.testing.assert_close(found, head(angles.expand(-1, 4, -1), geometry))


def test_colours_have_three_channels() -> None:
    spec = HeadsSpec()
    colour = Head(16, 3, spec, _seeded())(torch.zeros(2, 16), torch.zeros(2, spec.geometry_features))
    assert colour.shape == (2, 3)


def test_density_is_one_without_features_and_never_negative() -> None:
    density = Density(8, HeadsSpec(), _seeded())
    sigma, geometry = density(torch.zeros(3, 8))
    assert torch.equal(sigma, torch.ones(3)) and geometry.shape == (3, HeadsSpec().geometry_features)
    sigma, _ = density(1e6 * torch.randn(20, 8, generator=_seeded()))
    assert torch.isfinite(sigma).all() and (sigma >= 0.0).all()


def test_cells_of_the_grid_have_the_recipes_sizes_and_a_small_cube_has_two_and_four() -> None:
    spec = replace(FieldSpec(), coarsest_cell_m=4.0, finest_cell_m=0.5)
    layout = grid_layout(spec, 100.0)
    assert (layout.base_resolution, layout.finest_resolution) == (25, 200)
    assert (layout.levels, layout.features, layout.log2_table) == (
        spec.levels,
        spec.features,
        spec.log2_table,
    )
    small = grid_layout(spec, 1.0)
    assert (small.base_resolution, small.finest_resolution) == (2, 4)


def test_a_flow_is_divided_by_the_cubes_edge_unless_the_authors_way_is_asked_for() -> None:
    flow = torch.tensor([[1.0, -2.0, 4.0]])
    assert torch.equal(applied(flow, ReferenceQuirks(bound=2.0)), flow / 4.0)
    assert torch.equal(applied(flow, ReferenceQuirks()), flow / 2.0)
    assert torch.equal(applied(flow, ReferenceQuirks(flow_unit=True, bound=2.0)), flow)
