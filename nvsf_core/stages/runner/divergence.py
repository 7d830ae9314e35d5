"""Diverged trainings: their checkpoints are kept, and a recipe with smaller steps continues from them."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nvsf_core.errors import DivergedError, RecipeError, StoreError
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.presets import differ_in_step_size, full_name, recipe_from_json, share_of
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stores.checkpoints import load_tensors, save_tensors
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.scene_store import published

_DIVERGED = "diverged.json"
_WENT_ON = "went_on.json"
_CHECKPOINTS = "*.safetensors"


def owner(task: Task, recipe: Recipe) -> dict[str, object]:
    """Facts stored in a checkpoint: only a training of this recipe on these inputs resumes from it."""
    return {"recipe": recipe.identity(), "made_from": task.made_from}


@contextlib.contextmanager
def diverging(task: Task, work: Path, part: str) -> Iterator[None]:
    """Context of a part's training: record a divergence in `work`, and extend its error message.

    Raises:
        DivergedError: The part diverged; names scene, recipe and part, and says how to continue.
    """
    recipe = task.config.recipe
    try:
        yield
    except DivergedError as error:
        found = f"{part}: {error}"
        note = {"recipe": recipe.to_json(), "made_from": task.made_from, "found": found}
        (work / _DIVERGED).write_text(json.dumps(note))
        step = _saved_step(work / f"{part}.safetensors", owner(task, recipe))
        half = f"{full_name(recipe.name)}@{0.5 * share_of(recipe.name):g}"
        kept = "nothing was saved yet" if step is None else f"the checkpoint of step {step} is kept"
        goes = "begins again" if step is None else "goes on from it"
        raise DivergedError(
            f"scene {task.scene.name}, recipe {recipe.name}, {found}; {kept}: the recipe {half} {goes} "
            "with smaller steps"
        ) from error


def go_on(task: Task, work: Path) -> str:
    """Take over the checkpoints of a diverged training with larger steps, if this one has none of its own.

    Only those of the same inputs and of a recipe that differs in step sizes alone.

    Returns:
        Description of what was taken over; empty if nothing was.
    """
    recipe = task.config.recipe
    mine, said = owner(task, recipe), work / _WENT_ON
    if any(_saved_step(path, mine) is not None for path in work.glob(_CHECKPOINTS)):
        values = _noted(said)
        return str(values.get("words", "")) if values.get("recipe") == mine["recipe"] else ""
    for folder in _others(work, recipe.name):
        values = _noted(folder / _DIVERGED)
        faster = _recipe_of(values)
        if faster is None or not differ_in_step_size(faster, recipe):
            continue
        if values.get("made_from") != task.made_from:
            continue
        taken = []
        for path in sorted(folder.glob(_CHECKPOINTS)):
            step = _saved_step(path, owner(task, faster))
            if step is not None:
                tensors, facts = load_tensors(path)
                save_tensors(work / path.name, tensors, facts | mine)
                taken.append(f"{path.stem} from step {step}")
        if taken:
            words = f"{faster.name} diverged ({values.get('found')}); went on slower: {', '.join(taken)}"
            said.write_text(json.dumps({"recipe": mine["recipe"], "words": words}))
            task.progress(f"[{task.scene.name}] field: {words}")
            return words
    return ""


def _noted(path: Path) -> dict[str, Any]:
    """A note of an earlier training; empty if it is absent or not readable."""
    try:
        return read_document(path)
    except StoreError:
        return {}


def _recipe_of(values: dict[str, Any]) -> Recipe | None:
    """The recipe of a note; None if there is none of this version."""
    try:
        return recipe_from_json(values["recipe"])
    except (KeyError, TypeError, AttributeError, RecipeError):
        return None


def _others(work: Path, name: str) -> list[Path]:
    """Folders of diverged trainings of the recipe's full name with equal or larger steps, smallest first.

    They lie in `.work/field/<recipe>/<seed>`, of the same seed.
    """
    folders = [
        folder / work.name
        for folder in published(work.parent.parent, "*")
        if full_name(folder.name) == full_name(name) and _has_share(folder.name, share_of(name))
    ]
    return sorted(
        (folder for folder in folders if (folder / _DIVERGED).is_file()),
        key=lambda folder: share_of(folder.parent.name),
    )


def _has_share(name: str, least: float) -> bool:
    """Whether a folder's name is of a recipe with at least this share of the full step sizes."""
    try:
        return share_of(name) >= least
    except RecipeError:
        return False


def _saved_step(path: Path, of: dict[str, object]) -> int | None:
    """Step of a checkpoint; None if it is absent, not readable, or of another owner."""
    try:
        facts = load_tensors(path)[1]
    except StoreError:
        return None
    is_ours = all(facts.get(name) == value for name, value in of.items())
    step = facts.get("step")
    return step if is_ours and isinstance(step, int) else None
