"""Laws of the scene flow trained alone."""

from dataclasses import replace

import numpy as np
import torch

from nvsf_core.fields.flow import FlowField
from nvsf_core.losses.chamfer import chamfer_distance
from nvsf_core.models.paper.flow_training import flow_loss, train_flow
from nvsf_core.recipe.paper import FlowSpec, GridSpec, PaperOptimiser, PaperRecipe

SPEC = FlowSpec(
    grid=GridSpec(levels=2, features=4, log2_table=9, base_resolution=4, finest_resolution=8), points=400
)
RECIPE = PaperRecipe(name="tiny", flow=SPEC, optimiser=PaperOptimiser(head_rate=5e-3))
FRAME = np.array([0.0, 1.0, 2.0])
MOVED = np.array([0.03, 0.0, -0.01], np.float32)
"""From frame to frame, scaled units."""


def clouds(count: int = 300) -> list[np.ndarray]:
    """Three times the same points: half of them stand, the others move."""
    draws = np.random.default_rng(0)
    static = draws.uniform((-0.8, -0.8, -0.1), (-0.2, 0.8, 0.1), (count, 3))
    moving = draws.uniform((0.3, -0.2, -0.1), (0.6, 0.2, 0.1), (count, 3))
    return [np.concatenate([static, moving + k * MOVED]).astype(np.float32) for k in range(3)]


def quiet(_: str) -> None:
    """Say nothing."""


def field_and_draws(spec: FlowSpec = SPEC) -> tuple[FlowField, torch.Generator]:
    generator = torch.Generator().manual_seed(0)
    return FlowField(spec, generator), generator


def test_the_loss_is_the_sum_of_both_neighbours_chamfer_distances():
    flow, generator = field_and_draws()
    three = [cloud[:200] for cloud in clouds()]
    loss = flow_loss(flow, RECIPE, three, FRAME, 1, 0.5, generator)
    here = torch.from_numpy(three[1])
    forward, backward = flow(here / 2 + 0.5, 0.5)
    expected = chamfer_distance(here + forward, torch.from_numpy(three[2]))
    expected = expected + chamfer_distance(here + backward, torch.from_numpy(three[0]))
    torch.testing.assert_close(loss.total, expected)


def test_a_frame_without_neighbours_or_without_points_teaches_nothing():
    flow, generator = field_and_draws()
    three = clouds()
    assert flow_loss(flow, RECIPE, three, FRAME * 2, 1, 0.5, generator).terms == {}
    empty = [np.zeros((0, 3), np.float32), three[1], three[2]]
    assert flow_loss(flow, RECIPE, empty, FRAME, 0, 0.0, generator).terms == {}
    assert flow_loss(flow, RECIPE, empty, FRAME, 1, 0.5, generator).terms["flow"] > 0.0


def test_a_neighbour_is_the_frame_next_in_number_not_in_the_list():
    flow, generator = field_and_draws()
    three = [cloud[:200] for cloud in clouds()]
    # Frame 2 is held out: of frame 3 only frame 4 is a neighbour.
    loss = flow_loss(flow, RECIPE, three, np.array([1.0, 3.0, 4.0]), 1, 0.5, generator)
    here = torch.from_numpy(three[1])
    forward = flow(here / 2 + 0.5, 0.5)[0]
    torch.testing.assert_close(loss.total, chamfer_distance(here + forward, torch.from_numpy(three[2])))


def test_training_finds_what_moves_and_leaves_the_rest():
    state = train_flow(RECIPE, clouds(), FRAME, 3, 150, 0, quiet)
    with torch.no_grad():
        forward, backward = state.model(torch.from_numpy(clouds()[1]) / 2 + 0.5, 0.5)
    moving = np.arange(600) >= 300
    for found, true in ((forward, MOVED), (backward, -MOVED)):
        error = np.linalg.norm(found.numpy() - true * moving[:, None], axis=1)
        assert np.median(error[moving]) < 0.3 * np.linalg.norm(MOVED)
        assert np.median(error[~moving]) < 0.3 * np.linalg.norm(MOVED)


def test_a_weight_on_the_flow_itself_holds_it_at_nothing():
    # Why losses.flow_magnitude = 1 beside the paper's mean Chamfer distance learns no motion at all.
    held = replace(RECIPE, losses=replace(RECIPE.losses, flow_magnitude=1.0))
    state = train_flow(held, clouds(), FRAME, 3, 60, 0, quiet)
    with torch.no_grad():
        forward, _ = state.model(torch.from_numpy(clouds()[1]) / 2 + 0.5, 0.5)
    assert float(forward.norm(dim=1).median()) < 0.1 * float(np.linalg.norm(MOVED))


def test_a_seed_decides_every_bit():
    few = clouds(50)
    first, second = (train_flow(RECIPE, few, FRAME, 3, 5, 7, quiet) for _ in range(2))
    for a, b in zip(first.model.parameters(), second.model.parameters(), strict=True):
        assert torch.equal(a, b)
    other = train_flow(RECIPE, few, FRAME, 3, 5, 8, quiet)
    assert not torch.equal(next(first.model.parameters()), next(other.model.parameters()))
