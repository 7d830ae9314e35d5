"""Checkpoints of the stage `field`: saved during training, resumed after a kill."""

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from nvsf_core.errors import StoreError
from nvsf_core.models.family import ResumedPart
from nvsf_core.stages.runner.divergence import diverging, owner
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.training.loop import Save, TrainingState


@dataclass(frozen=True, slots=True)
class StageSession:
    """The `TrainingSession` of a task, with one checkpoint per part of the model in the folder `work`."""

    task: Task
    work: Path

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.task.config.seed

    def say(self, part: str, line: str, /) -> None:
        """Report progress: the line, after scene, stage and part."""
        self.task.progress(f"[{self.task.scene.name}] field, {part}: {line}")

    @contextlib.contextmanager
    def resumed(self, part: str, state: TrainingState, /) -> Iterator[ResumedPart]:
        """Restore the part's checkpoint into `state` (see `resume`); a divergence inside is recorded."""
        task, path = self.task, self.work / f"{part}.safetensors"
        observe = task.observe
        resume(task, state, path)
        with diverging(task, self.work, part):
            yield ResumedPart(
                save=saving(task, path),
                say=lambda line: self.say(part, line),
                observe=None if observe is None else lambda seen: observe(part, seen),
            )


def saving(task: Task, path: Path) -> Save:
    """A function that writes a checkpoint, marked with the task's recipe and inputs."""

    def save(tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        save_tensors(path, tensors, facts | owner(task, task.config.recipe))

    return save


def resume(task: Task, state: TrainingState, path: Path) -> None:
    """Restore `state` from a checkpoint, if it is readable and of the task's recipe and inputs."""
    if path.is_dir():
        shutil.rmtree(path)  # else the first checkpoint could not be written, after minutes
    if not path.is_file():
        return
    place = f"[{task.scene.name}] field, {path.stem}"
    try:
        tensors, facts = load_tensors(path)
    except StoreError as error:
        task.progress(f"{place}: checkpoint left aside: {error}")
        return
    if any(facts.get(name) != value for name, value in owner(task, task.config.recipe).items()):
        task.progress(f"{place}: checkpoint left aside: of another recipe or of other inputs")
        return
    try:
        state.restore(tensors, facts)
    except StoreError as error:
        task.progress(f"{place}: checkpoint left aside: {error}")
        return
    task.progress(f"{place}: resumed from the checkpoint at step {state.step}")
