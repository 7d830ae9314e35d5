"""Interpolation over time: slices and their weights, and the contraction over the nodes of the time basis."""

import pytest
import torch

from nvsf_core.encodings.hash_time import NODES, contract_nodes, cubic_basis, two_slices


@pytest.mark.parametrize(
    ("t", "slices", "expected"),
    [
        (0.0, 5, [(0, 1.0)]),
        (0.5, 5, [(2, 1.0)]),
        (1.0, 5, [(4, 1.0)]),
        (0.125, 5, [(0, 0.5), (1, 0.5)]),
        (0.6875, 5, [(2, 0.25), (3, 0.75)]),
        (0.3, 1, [(0, 1.0)]),
    ],
)
def test_a_time_lies_between_two_slices_or_on_one(t, slices, expected) -> None:
    assert two_slices(t, slices) == expected


def test_nodes_are_weighted_and_summed_feature_by_feature() -> None:
    # Two features at each of four nodes: 1, 2 | 10, 20 | 100, 200 | 1000, 2000.
    table = torch.tensor([[1.0, 2.0, 10.0, 20.0, 100.0, 200.0, 1000.0, 2000.0]])
    basis = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    assert torch.equal(contract_nodes(table, basis), torch.tensor([[4321.0, 8642.0]]))
    assert contract_nodes(table.half(), basis).dtype == torch.float16


@pytest.mark.parametrize("node", range(4))
def test_at_a_node_the_table_holds_the_nodes_own_values(node) -> None:
    table = torch.arange(12.0).reshape(1, 12)
    at_node = contract_nodes(table, cubic_basis(NODES[node]))
    assert torch.equal(at_node, table[:, 3 * node : 3 * node + 3])


def test_a_cubic_is_reproduced_and_times_outside_the_scene_are_refused() -> None:
    t = 0.2
    values = torch.tensor([1.0 + node - 2.0 * node**3 for node in NODES], dtype=torch.float64)
    assert float((cubic_basis(t) * values).sum()) == pytest.approx(1.0 + t - 2.0 * t**3, abs=1e-12)
    for outside in (-1e-9, 1.0 + 1e-9, float("nan")):
        with pytest.raises(ValueError, match="cubic_basis"):
            cubic_basis(outside)
