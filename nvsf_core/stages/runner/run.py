"""Run all stages of one scene without Dagster, or a single stage for a scheduler."""

import contextlib
import difflib
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry, catalogue_from_environment, home_from_environment
from nvsf_core.drives.drive import has_data, own_folders
from nvsf_core.drives.view_checks import require_views
from nvsf_core.drives.view_truth import require_truth
from nvsf_core.errors import DataError, NvsfError, StoreError
from nvsf_core.metrics.lpips_file import find_weights
from nvsf_core.names import printable
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.flow import STAGES
from nvsf_core.stages.runner.execution import (
    DamagedInputError,
    StagePlace,
    made_from,
    run_stage,
    skipped_stage,
)
from nvsf_core.stages.runner.failures import forget_failure, remember_failure
from nvsf_core.stages.runner.heartbeat import heartbeat, sparse
from nvsf_core.stages.runner.locks import LOCKS, device_lock, output_locks
from nvsf_core.stages.runner.same_drive import OtherDriveError, remember_drive, require_same_drive
from nvsf_core.stages.runner.stage import Outcome, Progress, RunConfig, Stage, Task, UnsoundOutputError
from nvsf_core.stores.removal import number_kept
from nvsf_core.stores.scene_store import SceneStore, require_home

DEMO_SCENE, STREET_SCENE = "demo", "street"
"""Scenes of the embedded street, short and full: their drives are written here where they are absent."""
DEFAULT_RECIPE = "lean"
"""Used if neither the user nor the catalogue names one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneRun:
    """One scene, the store of its outputs, and the requested recipe and seeds."""

    scene: SceneEntry
    store: SceneStore
    config: RunConfig

    def task(self, folder: Path, progress: Progress) -> Task:
        """A task of the run outside of its stages."""
        return Task(
            scene=self.scene, store=self.store, config=self.config, folder=folder, progress=progress
        )  # fmt: skip


def plan_run(
    scene: SceneEntry,
    home: Path,
    *,
    recipe: str | Recipe | None = None,
    seed: int = 0,
    draw_seed: int = 0,
    dataset_label: str = "manual",
) -> SceneRun:
    """Choose recipe and output folders of a run, and check all that would else fail after hours.

    Args:
        scene: A catalogue entry.
        home: Folder of all outputs.
        recipe: A preset's name or a recipe; default the catalogue's choice, else `lean`.
        seed: Seed of training.
        draw_seed: Seed of ray drop and range noise in the data set.
        dataset_label: First part of the data set's version.

    Raises:
        RecipeError: There is no preset of that name, or a seed is not valid.
        DataError: The label cannot be part of a folder's name, a view asks for what the drive cannot give,
            its true images are absent or of another size, or NVSF_KEEP_VERSIONS is no number.
        StoreError: The home cannot be written to, or NVSF_LPIPS_WEIGHTS names no file.
    """
    if not isinstance(scene, SceneEntry):
        raise DataError(f"expected a SceneEntry, found {scene!r:.60}; `find_scene` gives one by its name")
    require_views(scene)
    require_truth(scene)
    number_kept(os.environ)
    find_weights()
    home = require_home(home)
    _require_apart(scene, home)
    if not isinstance(recipe, Recipe):
        recipe = preset(scene.recipe or DEFAULT_RECIPE if recipe in (None, "") else recipe)
    config = RunConfig(recipe=recipe, seed=seed, draw_seed=draw_seed, dataset_label=dataset_label)
    return SceneRun(scene=scene, store=SceneStore(home=home, scene=scene.name), config=config)


def _require_apart(scene: SceneEntry, home: Path) -> None:
    """Refuse outputs inside the recorded drive, and a drive among its scene's outputs, which are replaced."""
    outputs = home / scene.name
    for own in own_folders(scene):
        if home.is_relative_to(own.resolve()):
            raise StoreError(f"NVSF_HOME={home} lies in the drive's own folder {own}; choose another")
        if outputs.is_relative_to(own.resolve()) or own.resolve().is_relative_to(outputs):
            raise StoreError(
                f"scene {scene.name}: expected its outputs apart from its drive, found that of {outputs} and "
                f"{own} one lies in the other, where stages would replace what is yours; move the drive, for "
                f"example to {home / 'drives' / scene.name}, name the scene otherwise, or choose another "
                "NVSF_HOME"
            )


# Wide: each argument is an independent choice of the caller; all but the scene have defaults.
def run_scene(
    scene: str | SceneEntry,
    home: Path | str | None = None,
    *,
    recipe: str | Recipe | None = None,
    seed: int = 0,
    draw_seed: int = 0,
    dataset_label: str = "manual",
    progress: Progress | None = None,
    stages: Sequence[Stage] | None = None,
) -> list[Outcome]:
    """Run every stage on one scene, in order; stages that are up to date are skipped.

    Args:
        scene: A catalogue entry, or its name in the catalogue that NVSF_SCENES points to.
        home: Folder of all outputs; default NVSF_HOME, else `.nvsf` in the working directory.
        recipe: A preset's name or a recipe; default the catalogue's choice, else `lean`.
        seed: Seed of training.
        draw_seed: Seed of ray drop and range noise in the data set.
        dataset_label: First part of the data set's version.
        progress: Receives progress lines; default standard error.
        stages: Stages to run; default the project's own.

    Raises:
        DataError: The catalogue has no such scene, or its drive is absent (NoDataError).
        NvsfError: A stage failed.
    """
    entry = find_scene(scene) if isinstance(scene, str) else scene
    say = progress or say_on_stderr
    run = plan_run(
        entry, Path(home) if home else home_from_environment(os.environ), recipe=recipe, seed=seed,
        draw_seed=draw_seed, dataset_label=dataset_label,
    )  # fmt: skip
    write_demo_where_absent(entry, say)
    chosen = STAGES if stages is None else tuple(stages)
    return [run_named_stage(stage.name, run, say, stages=chosen) for stage in chosen]


def run_named_stage(
    name: str, run: SceneRun, progress: Progress, *, stages: Sequence[Stage] | None = None
) -> Outcome:
    """Run, or skip, one stage whose inputs are published; a failure is remembered until it succeeds.

    Raises:
        StoreError: An input was never published.
        OtherDriveError: The home holds another drive's outputs under the scene's name; nothing is replaced.
        NvsfError: The stage failed; names scene and stage.
    """
    by_name = {stage.name: stage for stage in (STAGES if stages is None else stages)}
    if name not in by_name:
        raise DataError(f"no stage {name!r:.60}; there are {', '.join(by_name)}")
    stage = by_name[name]
    place = stage.location(run.config)
    try:
        outcome = _named(stage, run, by_name, progress)
    except OtherDriveError:
        raise  # no failure of the drive whose outputs lie there
    except Exception as error:
        kind = "" if isinstance(error, NvsfError) else f"{type(error).__name__}: "
        words = str(error).removeprefix(f"scene {run.scene.name}, stage {name}: ")
        remember_failure(run.store, place, kind + words)
        raise
    for own in {place, name}:  # by its name alone where it could not be planned
        forget_failure(run.store, own)
    return outcome


def _named(stage: Stage, run: SceneRun, by_name: Mapping[str, Stage], progress: Progress) -> Outcome:
    """Run or skip a stage; its errors name scene and stage."""
    name = stage.name
    try:
        return _run_or_skip(stage, run, by_name, progress)
    except OSError as error:
        raise StoreError(
            f"scene {run.scene.name}, stage {name}: the disk refused {error.filename or run.store.root} "
            f"({error.strerror or error}); free space, or mend what is in its place, and run again"
        ) from error
    except NvsfError as error:
        says_where = str(error).startswith(f"scene {run.scene.name}")
        if says_where or isinstance(error, DamagedInputError | UnsoundOutputError):
            raise
        raise type(error)(f"scene {run.scene.name}, stage {name}: {error}") from error


def _run_or_skip(stage: Stage, run: SceneRun, by_name: Mapping[str, Stage], progress: Progress) -> Outcome:
    """Run or skip a stage; a damaged input is made again first, and so are what that one reads."""
    for _ in stage.inputs:
        try:
            return _once(stage, run, by_name, progress)
        except DamagedInputError as error:
            progress(f"[{run.scene.name}] {stage.name}: its input {error.stage} is made again first: {error}")
            run_named_stage(error.stage, run, progress, stages=tuple(by_name.values()))
    return _once(stage, run, by_name, progress)


def _once(stage: Stage, run: SceneRun, by_name: Mapping[str, Stage], progress: Progress) -> Outcome:
    place, locks = place_of(stage, run, by_name), run.store.home / LOCKS / run.scene.name
    inputs = [place.inputs[source] for source in by_name if source in place.inputs]
    inputs += stage.versions
    # Who finds an output up to date only reads it: a run does not wait for another one's training.
    with output_locks(locks, None, [*inputs, place.location], progress):
        outcome = skipped_stage(place, progress)
    if outcome is None:
        with (
            _device_for(stage, run, progress),
            output_locks(locks, place.location, inputs, progress),
            heartbeat(progress, f"[{run.scene.name}] {stage.name}") as say,
        ):
            if stage.reads_drive:
                require_same_drive(run.store, run.scene, say)
            outcome = run_stage(place, say)
    if stage.reads_drive:
        remember_drive(run.store, run.scene)
    if stage.tidy is not None:
        stage.tidy(run.store, outcome, progress)
    return outcome


def field_made_from(run: SceneRun) -> str:
    """Digest of all that decides the run's stage `field` but the recipe; its checkpoints carry it.

    Raises:
        StoreError: An input was never published.
    """
    by_name = {stage.name: stage for stage in STAGES}
    return made_from(place_of(by_name["field"], run, by_name))


def find_scene(name: str) -> SceneEntry:
    """The catalogue's entry of that name.

    Raises:
        CatalogueError: The catalogue cannot be read.
        DataError: There is none, or the name is no text.
    """
    if not isinstance(name, str):
        raise DataError(f"expected a scene's name as text, found {name!r:.60}")
    catalogue = catalogue_from_environment(os.environ)
    for entry in catalogue:
        if entry.name == name:
            return entry
    known = {entry.name.casefold(): entry.name for entry in catalogue}
    near = [known[one] for one in difflib.get_close_matches(name.casefold(), known)]
    hint = f" (did you mean {' or '.join(near)}?)" if near else ""
    hint = " (names are separated by blanks)" if "," in name else hint
    raise DataError(
        f"no scene {name!r:.100} in the catalogue{hint}; it has {', '.join(known.values())}. NVSF_SCENES "
        "names other catalogues"
    )


def is_embedded(scene: SceneEntry) -> bool:
    """Whether the scene's drive is the embedded street, which is written where it is absent."""
    if scene.name not in (DEMO_SCENE, STREET_SCENE):
        return False
    # The writer loads scipy and cv2: imported only where a drive may be written.
    from nvsf_core.demo.drive import DEMO_SEQUENCE

    # A drive of the same name with another sequence is the user's own.
    return scene.sequence == DEMO_SEQUENCE


def write_demo_where_absent(scene: SceneEntry, progress: Progress) -> None:
    """Write the embedded drive if the scene is one of the embedded street and its drive is absent."""
    if has_data(scene) or not is_embedded(scene):
        return
    from nvsf_core.demo.drive import DemoSize, write_demo

    size = DemoSize.full() if scene.name == STREET_SCENE else DemoSize.short()
    progress(f"[{scene.name}] drive: writing the embedded street to {scene.root}")
    started, say = time.perf_counter(), sparse(progress)
    write_demo(
        scene.root, size=size, progress=lambda done, n: say(f"[{scene.name}] drive: {done} of {n} frames")
    )
    progress(f"[{scene.name}] drive: written in {time.perf_counter() - started:.1f} s")


def say_on_stderr(line: str, /) -> None:
    """Write a progress line to standard error."""
    sys.stderr.write(printable(line) + "\n")
    sys.stderr.flush()


def place_of(stage: Stage, run: SceneRun, by_name: Mapping[str, Stage]) -> StagePlace:
    """A stage on a run's scene; `by_name` has the stages that it reads."""
    return StagePlace(
        stage=stage,
        scene=run.scene,
        store=run.store,
        config=run.config,
        inputs={source: by_name[source].location(run.config) for source in stage.inputs},
    )


@contextlib.contextmanager
def _device_for(stage: Stage, run: SceneRun, progress: Progress) -> Iterator[None]:
    """Hold the device lock around a stage that trains; other stages need none."""
    if stage.group != "train":
        yield
        return
    with device_lock(run.store.home / LOCKS, progress):
        yield
