"""Trains the paper's ray-drop U-Net, which corrects the hit probabilities of whole panos."""

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.recipe.paper import RefinementSpec
from nvsf_core.training.loop import (
    Save,
    TrainingState,
    first_broken,
    has_finite_gradients,
    require_finite_parameters,
)

_MOST_BOXES = 31
_BOX_PX = (5, 102)
"""Largest height and width of a blanked box in a pano of the size below; in proportion in others."""
_PANO_PX = (66, 1030)
_WARM_SHARE = 0.3
_FIRST_DIVISOR = 25.0
_LAST_DIVISOR = 1e4
_LEAST_BETA, _MOST_BETA = 0.85, 0.95
_SAY_EVERY_S = 4.0
_SEED_RANGE = 2**62


def refinement_state(unet: nn.Module, spec: RefinementSpec, generator: torch.Generator) -> TrainingState:
    """The state of a U-Net before its first step; a checkpoint is restored into it."""
    optimiser = torch.optim.Adam(unet.parameters(), lr=spec.rate, fused=True)
    return TrainingState(unet, optimiser, generator)


def refine(
    state: TrainingState,
    spec: RefinementSpec,
    renders: Tensor,
    is_return: Tensor,
    save: Save,
    say: Callable[[str], None],
    *,
    checkpoint_s: float = 60.0,
) -> None:
    """Run the remaining steps; the loss is the cross-entropy between the U-Net's logits and recorded returns.

    A step uses all frames (or the next `spec.frames_a_step` of them), one at a time to save memory: their
    gradients add up to that of the mean over all pixels, and batch statistics are those of one frame. Each
    step blanks 0 to 31 random boxes of the input, so that the U-Net learns to close gaps. The same state,
    stopped anywhere and restored, gives the same bits.

    Args:
        state: Of `refinement_state`, changed in place; its generator decides boxes and dropout.
        spec: Steps, highest learning rate, frames a step.
        renders: (n, 3, H, W) hit probability, intensity, range in scaled units of all training frames, on
            any device.
        is_return: (n, H, W) whether each pixel has a recorded return, bool or 0 and 1.
        save: Writes a checkpoint of tensors and facts, every `checkpoint_s` seconds and at the end.
        say: Prints a line of progress, every few seconds.
        checkpoint_s: Seconds between two checkpoints.

    Raises:
        ShapeError: There is no frame, or renders and returns differ in size.
        DivergedError: The loss, a render or a weight is not finite; names the step.
    """
    n = len(renders)
    if n == 0 or renders.ndim != 4 or is_return.shape != (n, *renders.shape[2:]):
        raise ShapeError(
            f"refine: expected renders (n, 3, H, W) and returns (n, H, W), n >= 1, found "
            f"{tuple(renders.shape)} and {tuple(is_return.shape)}"
        )
    if not bool(torch.isfinite(renders).all()):
        raise DivergedError("refine: expected finite renders, found NaN or infinity; render them again")
    began = time.perf_counter() - state.seconds
    saved = said = time.perf_counter()
    state.model.train()
    while state.step < spec.steps:
        loss = _step(state, spec, renders, is_return)
        state.step += 1
        now = time.perf_counter()
        state.seconds = now - began
        state.curve.append({"step": state.step, "seconds": state.seconds, "loss": loss})
        if now - said >= _SAY_EVERY_S:
            said = now
            say(f"refinement step {state.step}/{spec.steps}, loss {loss:.4f}")
        if now - saved >= checkpoint_s or state.step == spec.steps:
            require_finite_parameters(state.model, state.step)
            save(state.tensors(), state.facts())
            saved = time.perf_counter()
    state.model.eval()


def one_cycle(step: int, steps: int, highest: float) -> tuple[float, float]:
    """Adam's learning rate and beta_1 at a step of Smith's one-cycle schedule with cosines.

    The rate rises from highest / 25 to `highest` in the first 30 % of the steps and falls to highest /
    250,000 in the rest; beta_1 goes from 0.95 to 0.85 and back: torch's OneCycleLR with its defaults, but
    without a state.
    """
    peak, last = _WARM_SHARE * steps - 1.0, steps - 1.0
    first, final = highest / _FIRST_DIVISOR, highest / _FIRST_DIVISOR / _LAST_DIVISOR
    if step <= peak:
        share = step / peak
        return _between(first, highest, share), _between(_MOST_BETA, _LEAST_BETA, share)
    share = (step - peak) / (last - peak)
    return _between(highest, final, share), _between(_LEAST_BETA, _MOST_BETA, share)


def blanked_boxes(height: int, width: int, generator: torch.Generator) -> Tensor:
    """(H, W) bool, True in 0 to 31 random boxes.

    In a pano of 66 x 1030 they are 1 to 5 pixels high and 1 to 102 wide; in others the largest box is in the
    same proportion, at least 1 pixel.
    """
    blank = torch.zeros(height, width, dtype=torch.bool)
    most = [
        max(1, round(box * size / full))
        for box, size, full in zip(_BOX_PX, (height, width), _PANO_PX, strict=True)
    ]
    count = int(torch.randint(_MOST_BOXES + 1, (1,), generator=generator))
    for _ in range(count):
        high, wide = (int(torch.randint(1, m + 1, (1,), generator=generator)) for m in most)
        row = int(torch.randint(max(1, height - high + 1), (1,), generator=generator))
        column = int(torch.randint(max(1, width - wide + 1), (1,), generator=generator))
        blank[row : row + high, column : column + wide] = True
    return blank


def _step(state: TrainingState, spec: RefinementSpec, renders: Tensor, is_return: Tensor) -> float:
    """Take one optimiser step; returns its loss in nats a pixel."""
    device = next(state.model.parameters()).device
    n = len(renders)
    count = min(n, spec.frames_a_step) or n
    frames = [(state.step * count + k) % n for k in range(count)]
    blank = blanked_boxes(renders.shape[2], renders.shape[3], state.generator).to(device)
    rate, beta = one_cycle(state.step, spec.steps, spec.rate)
    for group in state.optimiser.param_groups:
        group["lr"], group["betas"] = rate, (beta, group["betas"][1])
    state.optimiser.zero_grad(set_to_none=True)
    total = 0.0
    # Dropout samples from torch's global generators: seeded here, so that a resumed run samples the same.
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(torch.randint(_SEED_RANGE, (1,), generator=state.generator)))
        for frame in frames:
            logits = state.model(renders[[frame]].to(device).masked_fill(blank, 0.0))
            loss = binary_cross_entropy_with_logits(logits, is_return[[frame]].to(device, logits.dtype))
            if not torch.isfinite(loss):
                raise DivergedError(
                    f"refinement step {state.step}: loss term 'hit' is {loss.item()}; lower the rate "
                    f"({first_broken(state)})"
                )
            (loss * (1.0 / count)).backward()  # type: ignore[no-untyped-call]
            total += 1.0 / count * float(loss.detach())
    if not has_finite_gradients(state.model):
        raise DivergedError(
            f"refinement step {state.step}: loss term 'hit': {first_broken(state)}; lower the rate"
        )
    state.optimiser.step()
    return total


def _between(start: float, end: float, share: float) -> float:
    """Value between start and end at a share 0..1 of half a cosine."""
    return end + 0.5 * (start - end) * (1.0 + math.cos(math.pi * share))
