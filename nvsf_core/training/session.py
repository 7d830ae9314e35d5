"""What a training runs with: the device, and from its caller the seed, checkpoints and progress lines."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import torch

from nvsf_core._types import Say
from nvsf_core.recipe import TrainingSpec
from nvsf_core.training.loop import Save, Step, TrainingState, train


def training_device() -> torch.device:
    """CUDA's first visible device, else the CPU; `CUDA_VISIBLE_DEVICES=` keeps a training on the CPU."""
    return torch.device(_kind())


def _kind() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True, slots=True)
class ResumedPart:
    """One part of a model, restored from its checkpoint if it has one."""

    save: Save
    """Writes a checkpoint."""
    say: Say
    """Prints a line of progress."""
    observe: Callable[[TrainingState], None] | None
    """Called with the state after each step, or None."""


class TrainingSession(Protocol):
    """The training of one scene's model, part by part: its LiDAR, its camera, ..."""

    @property
    def seed(self) -> int:
        """Decides the initial weights and what each step samples."""

    def say(self, part: str, line: str, /) -> None:
        """Print a line of progress of a part."""

    def resumed(self, part: str, state: TrainingState, /) -> AbstractContextManager[ResumedPart]:
        """Context of a part's training; restores `state` from the part's checkpoint if there is one.

        Raises:
            DivergedError: Training inside diverged; scene, recipe and part are added to the message.
        """


def fit(
    session: TrainingSession, part: str, state: TrainingState, spec: TrainingSpec, step: Step
) -> TrainingState:
    """Train one part of a scene's model, from its checkpoint if there is one; returns `state`.

    Args:
        session: Holds the checkpoints.
        part: Name of the part, for checkpoints and progress lines.
        state: Before the first step.
        spec: Of the loop.
        step: Gives the loss of a step.

    Raises:
        DivergedError: A loss, gradient or weight is not finite; scene, recipe, part and step are named.
    """
    with session.resumed(part, state) as one:
        train(state, spec, step, one.save, one.say, one.observe)
    return state
