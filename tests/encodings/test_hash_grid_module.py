"""Laws of the trainable hash grid."""

import torch

from nvsf_core.kernels.encodings.hash_grid import GridLayout, HashGrid

LAYOUT = GridLayout(levels=4, features=2, log2_table=12, base_resolution=4, finest_resolution=64)


def test_the_table_starts_small_uniform_and_from_the_generator_alone():
    first = HashGrid(LAYOUT, torch.Generator().manual_seed(5))
    again = HashGrid(LAYOUT, torch.Generator().manual_seed(5))
    table = first.table.detach()
    assert torch.equal(table, again.table.detach())
    assert table.abs().max() <= 1e-4
    assert abs(table.std().item() - 1e-4 / 3**0.5) < 2e-6


def test_two_grids_of_one_generator_start_differently():
    generator = torch.Generator().manual_seed(5)
    assert not torch.equal(HashGrid(LAYOUT, generator).table, HashGrid(LAYOUT, generator).table)


def test_leading_axes_are_kept():
    grid = HashGrid(LAYOUT, torch.Generator().manual_seed(0))
    positions = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(1))
    encoded = grid(positions)
    assert encoded.shape == (3, 5, grid.outputs)
    assert torch.equal(encoded[1, 2], grid(positions[1, 2:3])[0])


def test_it_learns_a_function_of_position():
    generator = torch.Generator().manual_seed(0)
    grid = HashGrid(LAYOUT, generator)
    optimiser = torch.optim.Adam(grid.parameters(), lr=0.02)
    errors = []
    for _ in range(60):
        positions = torch.rand(2048, 3, generator=generator)
        target = torch.sin(6 * positions[:, 0]) * positions[:, 1]
        error = (grid(positions).sum(dim=1) - target).square().mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
        errors.append(error.item())
    assert errors[-1] < 0.02 * errors[0]
