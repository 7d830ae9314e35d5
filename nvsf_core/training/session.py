"""What a training needs of whoever runs it: a seed, checkpoints, and somebody to tell how far it is."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from nvsf_core._types import Say
from nvsf_core.recipe import TrainingSpec
from nvsf_core.training.loop import Save, Step, TrainingState, train


@dataclass(frozen=True, slots=True)
class ResumedPart:
    """One part of a model, ready to go on from where its training was killed."""

    save: Save
    """Writes a checkpoint."""
    say: Say
    observe: Callable[[TrainingState], None] | None
    """Sees the state after each step; None where nobody watches."""


class TrainingSession(Protocol):
    """The training of one scene's model, part by part: its LiDAR, its camera, ..."""

    @property
    def seed(self) -> int:
        """Of the weights' first values and of what a step learns from."""

    def say(self, part: str, line: str, /) -> None:
        """Tell the person who waits."""

    def resumed(self, part: str, state: TrainingState, /) -> AbstractContextManager[ResumedPart]:
        """Around a part's training: `state` goes on from the part's checkpoint where there is one.

        Raises:
            DivergedError: What diverged inside, with the names of scene, recipe and part.
        """


def fit(
    session: TrainingSession, part: str, state: TrainingState, spec: TrainingSpec, step: Step
) -> TrainingState:
    """Train one part of a scene's model, from its checkpoint where there is one.

    Raises:
        DivergedError: A loss, gradient or weight is not finite; scene, recipe, part and step are named.
    """
    with session.resumed(part, state) as one:
        train(state, spec, step, one.save, one.say, one.observe)
    return state
