"""Saves the weights at fixed seconds of a training; the clock is stopped meanwhile."""

import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from nvsf_core.stores.checkpoints import save_tensors
from nvsf_core.training.loop import TrainingState

LIDAR, CAMERA, BOTH = "lidar", "camera", "both"
_PARTS = {"lidar": (LIDAR, "lidar."), "depth": (CAMERA, None), "pano": ("pano", None),
          "field": (BOTH, "field.")}  # fmt: skip
"""Part of a training to the clock that it runs by, and what stands before its weights' names in the published
model; None = what it trains shows nothing by itself yet. Other parts go on by the clock that runs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Marked:
    """Weights at one mark."""

    clock: str
    """`lidar`, `camera`, or `both` where one model is trained for both."""
    mark_s: float
    """The fixed time."""
    seconds: float
    """When they were really saved: at the end of the first step after it."""
    path: Path
    """The part's tensors, named as in the published model."""


@dataclass(slots=True)
class Marks:
    """An observer of one training (`Task.observe`).

    A clock starts where the one before it stopped, the first when this object is made; so what a part
    prepares before its first step counts, and saving does not. A mark that passes before a part's first
    step has ended is left out, because there was no model then; of several that pass during one step, all
    but the last.
    """

    folder: Path
    marks_s: Sequence[float]
    """Ascending."""
    before_s: Mapping[str, float]
    """Clock to the seconds that were spent before training began, on what it starts from."""
    found: list[Marked] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    """Clock to where it stands."""
    _clock: str = ""
    _part: str = ""
    _started: float = field(default_factory=time.perf_counter)
    _seen: float = field(default_factory=time.perf_counter)
    _passed: int = 0

    def __call__(self, part: str, state: TrainingState, /) -> None:
        """Save the part's weights if a mark has passed."""
        now = time.perf_counter()
        clock, prefix = _PARTS.get(part, (self._clock or LIDAR, None))
        if clock != self._clock:
            self._started = self._seen if self._clock else self._started
            self._clock = clock
        seconds = self.seconds[clock] = now - self._started + self.before_s.get(clock, 0.0)
        passed = bisect_right(self.marks_s, seconds)
        is_first, self._part = part != self._part, part
        if passed > self._passed and prefix is not None and not is_first:
            mark = self.marks_s[passed - 1]
            path = self.folder / f"{clock}-{mark:g}.safetensors"
            save_tensors(path, _weights(state, prefix))
            self.found.append(Marked(clock=clock, mark_s=mark, seconds=seconds, path=path))
        self._passed = passed
        self._seen = time.perf_counter()
        self._started += self._seen - now

    def finish(self) -> None:
        """Stop the clock that runs; what came after its last step (a U-Net, validation) counts to it."""
        if self._clock:
            spent = time.perf_counter() - self._started
            self.seconds[self._clock] = spent + self.before_s.get(self._clock, 0.0)


def _weights(state: TrainingState, prefix: str) -> dict[str, Tensor]:
    """The weights that would be rendered with, averaged where the recipe averages."""
    # The paper's trainee is a module that holds the field beside its error maps.
    own = "" if prefix == "field." else prefix
    with state.average.in_place() if state.average is not None else nullcontext():
        return {
            own + name: value.detach().clone()
            for name, value in state.model.state_dict().items()
            if own or name.startswith(prefix)
        }
