"""Trains the paper's ray-drop U-Net, which corrects the hit probabilities of whole panos."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe.paper import RefinementSpec
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.training.adam import Adam
from nvsf_core.training.loop import Save, TrainingState, train

_MOST_BOXES = 31
_BOX_PX = (5, 102)
"""Largest height and width of a blanked box in a pano of the size below; in proportion in others."""
_PANO_PX = (66, 1030)
_WARM_SHARE = 0.3
_FIRST_DIVISOR = 25.0
_LAST_DIVISOR = 1e4
_LEAST_BETA, _MOST_BETA = 0.85, 0.95
_SEED_RANGE = 2**62


def refinement_state(unet: nn.Module, spec: RefinementSpec, generator: torch.Generator) -> TrainingState:
    """The state of a U-Net before its first step; a checkpoint is restored into it."""
    groups = [{"params": list(unet.parameters()), "lr": spec.rate, "initial_lr": spec.rate}]
    optimiser = Adam(groups)
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
        DivergedError: A render is not finite, or as `train`.
    """
    n = len(renders)
    if n == 0 or renders.ndim != 4 or is_return.shape != (n, *renders.shape[2:]):
        raise ShapeError(
            f"refine: expected renders (n, 3, H, W) and returns (n, H, W), n >= 1, found "
            f"{tuple(renders.shape)} and {tuple(is_return.shape)}"
        )
    if not bool(torch.isfinite(renders).all()):
        raise DivergedError("refine: expected finite renders, found NaN or infinity; render them again")
    loop = TrainingSpec(
        steps=spec.steps, rays=_frames_a_step(spec, renders) * is_return[0].numel(), final_share=1.0,
        checkpoint_s=checkpoint_s,
    )  # fmt: skip
    state.model.train()
    train(state, loop, lambda step, _: [lambda: _losses(state, spec, step, renders, is_return)], save, say)
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


def _frames_a_step(spec: RefinementSpec, renders: Tensor) -> int:
    return min(len(renders), spec.frames_a_step) or len(renders)


def _losses(
    state: TrainingState, spec: RefinementSpec, step: int, renders: Tensor, is_return: Tensor
) -> Iterator[LossBreakdown]:
    """The loss of one step, frame by frame, in nats a pixel; sets the optimiser's rates."""
    device = next(state.model.parameters()).device
    n, count = len(renders), _frames_a_step(spec, renders)
    blank = blanked_boxes(renders.shape[2], renders.shape[3], state.generator).to(device)
    rate, beta = one_cycle(step, spec.steps, spec.rate)
    for group in state.optimiser.param_groups:
        group["lr"], group["betas"] = rate, (beta, group["betas"][1])
    # Dropout samples from torch's global generators: seeded here, so that a resumed run samples the same.
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(torch.randint(_SEED_RANGE, (1,), generator=state.generator)))
        for frame in ((step * count + k) % n for k in range(count)):
            logits = state.model(renders[[frame]].to(device).masked_fill(blank, 0.0))
            truth = is_return[[frame]].to(device, logits.dtype)
            hit = binary_cross_entropy_with_logits(logits, truth)
            yield replace(total_loss({"hit": hit}, {"hit": 1.0 / count}), terms={})


def _between(start: float, end: float, share: float) -> float:
    """Value between start and end at a share 0..1 of half a cosine."""
    return end + 0.5 * (start - end) * (1.0 + math.cos(math.pi * share))
