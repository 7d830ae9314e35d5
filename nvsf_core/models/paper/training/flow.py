"""One step of the scene flow, and the flow trained without anything else."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from nvsf_core.fields.flow import FlowField
from nvsf_core.losses.scene_flow import flow_magnitude, scene_flow_loss
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import PaperRecipe, TrainingSpec
from nvsf_core.training.loop import TrainingState, train


def flow_loss(
    flow: FlowField,
    recipe: PaperRecipe,
    clouds: Sequence[np.ndarray],
    frame: np.ndarray,
    row: int,
    t: float,
    generator: torch.Generator,
) -> LossBreakdown:
    """L_flow of one frame towards those of its two neighbours that are there; empty without a cloud.

    Args:
        flow: Learns.
        recipe: Points a cloud, weights, and the unit cube's bound.
        clouds: Each (m, 3) float32, scaled units, without ground.
        frame: (k,) frame coordinate of each cloud.
        row: Which cloud is moved.
        t: Its time in [0, 1].
        generator: Draws points where a cloud has more than `recipe.flow.points`.
    """
    device = next(flow.parameters()).device
    here = _drawn(clouds[row], recipe.flow.points, generator, device)
    if not len(here):
        return total_loss({}, {})
    forward, backward = flow(here / (2.0 * recipe.slips.bound) + 0.5, t)
    after, before = (
        _drawn(clouds[int(found[0])], recipe.flow.points, generator, device)
        if len(found := np.flatnonzero(frame == frame[row] + step))
        else None
        for step in (1.0, -1.0)
    )
    terms = {"flow": scene_flow_loss(here, forward, backward, after, before)}
    if recipe.losses.flow_magnitude:
        terms["flow_magnitude"] = flow_magnitude(forward, backward)
    # The paper adds the distances to both neighbours.
    return total_loss(terms, asdict(recipe.losses), ("flow",))


def train_flow(
    recipe: PaperRecipe,
    clouds: Sequence[np.ndarray],
    frame: np.ndarray,
    count: int,
    steps: int,
    seed: int,
    say: Callable[[str], None],
) -> TrainingState:
    """Train the flow field alone: each step moves the cloud of one random frame.

    Args:
        recipe: Its `flow`, `optimiser` (rate and decay) and `slips.bound` are used.
        clouds: Each (m, 3) float32, scaled units, without ground.
        frame: (k,) frame coordinates 0..count - 1 of the clouds.
        count: Frames of the scene, those without a cloud included.
        steps: Optimiser steps.
        seed: Of the weights and of all draws.
        say: Takes a line now and then.

    Returns:
        The state after the last step; its `model` is the `FlowField`.

    Raises:
        DivergedError: The loss or a weight is not finite.
    """
    spec, generator = recipe.optimiser, torch.Generator().manual_seed(seed)
    flow = FlowField(recipe.flow, generator)
    groups = [{"params": list(flow.parameters()), "lr": spec.head_rate, "initial_lr": spec.head_rate}]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
    state = TrainingState(flow, optimiser, generator)
    last = max(1, count - 1)

    def step(_: int, sampler: torch.Generator) -> Iterator[LossBreakdown]:
        row = int(torch.randint(len(clouds), (1,), generator=sampler))
        yield flow_loss(flow, recipe, clouds, frame, row, float(frame[row]) / last, sampler)

    loop = TrainingSpec(
        steps=steps, rays=recipe.flow.points, final_share=spec.final_share, checkpoint_s=1e9,
        threads=spec.threads,
    )  # fmt: skip
    train(state, loop, step, lambda tensors, facts: None, say)
    return state


def _drawn(cloud: np.ndarray, most: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """At most that many points of a cloud (m, 3), without replacement."""
    points = torch.from_numpy(cloud)
    if len(points) > most:
        points = points[torch.randperm(len(points), generator=generator)[:most]]
    return points.to(device)
