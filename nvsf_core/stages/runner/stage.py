"""Stages and their checks, and how one stage is run: skipped if nothing changed, else published whole."""

import hashlib
import json
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from nvsf_core._types import Scalar
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import CheckFailedError, DataError, StoreError
from nvsf_core.names import name_fault
from nvsf_core.recipe import Recipe, require_seed
from nvsf_core.stages.runner.listings import drive_listing, truth_listing
from nvsf_core.stages.runner.record import RECORD_NAME, damage_of, listed_files, read_record
from nvsf_core.stores.documents import write_document
from nvsf_core.stores.scene_store import SceneStore

NOT_RUN = "not run"
"""First words of the detail of a check that could not be made."""


class Progress(Protocol):
    """Receives progress lines for the user."""

    def __call__(self, line: str, /) -> None:
        """Show `line`."""


class Observer(Protocol):
    """Watches a training from outside, for example to score it at given seconds."""

    def __call__(self, part: str, state: Any, /) -> None:
        """See a part of the model after one of its steps.

        Args:
            part: Name of the checkpoint's file: `lidar`, `camera`, ...
            state: A `nvsf_core.training.loop.TrainingState`, not to be changed. (Typed `Any` because its
                module loads torch, which importing this one must not.)
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """Recipe, seeds and data set label of a run."""

    recipe: Recipe
    """Recipe of training and rendering."""
    seed: int = 0
    """Seed of training."""
    draw_seed: int = 0
    """Seed of ray drop and range noise in a data set."""
    dataset_label: str = "manual"
    """First part of a data set's version: an ISO week, or `manual`."""

    def __post_init__(self) -> None:
        """Refuse seeds that are not valid, and a label that cannot be part of a folder's name."""
        require_seed(self.seed)
        require_seed(self.draw_seed, "draw_seed")
        fault = name_fault(self.dataset_label)
        if fault is not None:
            raise DataError(f"dataset_label: {fault}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """The outcome of one check of a stage's output."""

    name: str
    """The condition in snake_case, for example `all_frames_have_a_pose`."""
    passed: bool
    """Whether the condition holds."""
    detail: str
    """Findings in words and numbers."""
    blocking: bool = False
    """A failed blocking check keeps the output from being published."""
    value: float | None = None
    """The measured number; None if the check has none, or was not run."""
    limit: float | None = None
    """Largest allowed `value`."""
    unit: str = ""
    """Unit of both; empty for shares and counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedCheck:
    """A check that a stage makes of every scene; the UI and the report show it separately."""

    name: str
    """Name of its `Check`."""
    description: str
    """The condition, its reason, and the source of its limit."""
    blocking: bool = False
    """Whether a failure makes the output unusable; else it only warns."""

    def outcome(self, value: float, limit: float, detail: str, unit: str = "") -> Check:
        """The check's outcome: passed if `value` is at most `limit`; NaN fails."""
        return Check(
            name=self.name, passed=value <= limit, detail=detail, blocking=self.blocking, value=value,
            limit=limit, unit=unit,
        )  # fmt: skip

    def not_run(self, reason: str) -> Check:
        """The outcome if the check could not be made: passed, with the reason."""
        return Check(name=self.name, passed=True, detail=f"{NOT_RUN}: {reason}", blocking=self.blocking)


class UnsoundOutputError(CheckFailedError):
    """Blocking checks failed; holds the outcomes of all checks."""

    def __init__(self, message: str, checks: Sequence[Check]) -> None:
        """Take the message, which names the failed checks, and the outcomes of all."""
        super().__init__(message)
        self.checks = tuple(checks)


@dataclass(slots=True, kw_only=True)
class StageOutput:
    """A stage's report on its output."""

    metadata: dict[str, Scalar] = field(default_factory=dict)
    """Numbers and texts for tables and the UI, with units in the keys."""
    checks: list[Check] = field(default_factory=list)
    """Outcomes of the stage's checks."""
    previews: dict[str, str] = field(default_factory=dict)
    """Name to file of PNG pictures inside the output folder, each below 100 kB."""
    beside: list[str] = field(default_factory=list)
    """Outputs published outside its own folder, by their place below the scene's folder."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Arguments of a stage's `run` and `check`."""

    scene: SceneEntry
    store: SceneStore
    config: RunConfig
    folder: Path
    """Empty folder to fill; published whole when `run` returns."""
    progress: Progress
    observe: Observer | None = None
    """Watches the training; its time is not counted."""
    made_from: str = ""
    """Digest by `made_from`; identifies checkpoints of the same inputs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One step of the flow and one asset of the lineage."""

    name: str
    group: str
    """Asset group: ingest, prepare, train, synthesis or report."""
    inputs: tuple[str, ...]
    """Names of the stages whose outputs it reads."""
    description: str
    """One sentence on its output, shown in the UI."""
    version: str
    """Raised when the code's output changes."""
    run: Callable[[Task], StageOutput]
    per_recipe: bool = False
    """Whether recipe and seed are part of its identity and its path."""
    per_draw: bool = False
    """Whether the draw seed and the data set's label are part of its identity."""
    reads_drive: bool = False
    """Whether the drive's files (names, sizes, times) are part of its identity."""
    reads_views: bool = False
    """Whether the catalogue's views of the scene are part of its identity."""
    reads_truth: bool = False
    """Whether the files of the views' true images (names, sizes, times) are part of its identity."""
    check: Callable[[Task], list[Check]] | None = None
    """Checks the output in the task's folder, just made or published earlier."""
    check_version: str = ""
    """Raised when `check` changes: outputs that are up to date are then checked again, not made again."""
    named_checks: tuple[NamedCheck, ...] = ()
    """The checks, of `run` or `check`, that the UI and the report show separately."""

    def location(self, config: RunConfig) -> str:
        """Path of its output below the scene's folder."""
        if not self.per_recipe:
            return self.name
        if self.per_draw:
            # The data sets' versions lie under the stage's name; records are kept apart from them.
            draw = f"{config.seed}-{config.draw_seed}-{config.dataset_label}"
            return f"{self.name}/.index/{config.recipe.name}/{draw}"
        return f"{self.name}/{config.recipe.name}/{config.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of one stage's run on one scene."""

    stage: str
    path: Path
    skipped: bool
    seconds: float
    metadata: dict[str, Scalar]
    checks: tuple[Check, ...]
    previews: dict[str, Path]
    fingerprint: str


def run_stage(
    stage: Stage,
    scene: SceneEntry,
    store: SceneStore,
    config: RunConfig,
    progress: Progress,
    input_fingerprints: dict[str, str],
    input_locations: Collection[str] = (),
) -> Outcome:
    """Run one stage, or skip it if its code, configuration and inputs are unchanged.

    An output whose files have changed since it was published is made again. Input files are compared with
    their checksums first, so that damaged data are never used.

    Args:
        stage: The stage to run.
        scene: The scene to run it on.
        store: The scene's outputs.
        config: Recipe and seeds.
        progress: Receives progress lines.
        input_fingerprints: Name of each input stage to the fingerprint of its output.
        input_locations: Paths of these outputs below the scene's folder.

    Raises:
        StoreError: The files of an input have changed since it was published.
        UnsoundOutputError: A blocking check failed; nothing was published.
        NvsfError: The stage failed.
    """
    location = stage.location(config)
    facts = _facts(stage, scene, config, input_fingerprints)
    fingerprint = _digest(facts)
    inputs_digest = _without_recipe(facts)
    record = read_record(store.recovered(location))

    def task(folder: Path) -> Task:
        return Task(
            scene=scene, store=store, config=config, folder=folder, progress=progress, made_from=inputs_digest
        )  # fmt: skip

    if record is not None and record["fingerprint"] == fingerprint:
        damage = damage_of(store, location, record)
        if damage is not None:
            progress(f"[{scene.name}] {stage.name}: made again, {damage} is not what was published")
            record = None
    if record is not None and record["fingerprint"] == fingerprint:
        progress(f"[{scene.name}] {stage.name}: up to date, skipped")
        record = _checked_again(stage, task(store.path(location)), record)
        return _outcome(stage, store.path(location), record, skipped=True)
    for place in input_locations:
        damage = damage_of(store, place, read_record(store.require(place)) or {})
        if damage is not None:
            raise StoreError(f"{damage} is not what was published; run the stage {place.split('/')[0]} again")
    progress(f"[{scene.name}] {stage.name}: started")
    # Here, because it loads torch and numba: asking what is there must not wait for them.
    from nvsf_core.kernels.threads import use_threads

    use_threads()
    started = time.perf_counter()
    with store.publish(location) as folder:
        output = stage.run(task(folder))
        _require_contract(stage, scene, location, folder)
        record = {
            "fingerprint": fingerprint,
            "version": stage.version,
            "metadata": output.metadata,
            "previews": output.previews,
            **_checked(stage, task(folder), output.checks),
            "seconds": time.perf_counter() - started,
            "files": listed_files(store, folder, output.previews.values(), output.beside),
        }
        write_document(folder / RECORD_NAME, record)
    progress(f"[{scene.name}] {stage.name}: done in {record['seconds']:.1f} s")
    return _outcome(stage, store.path(location), record, skipped=False)


def _require_contract(stage: Stage, scene: SceneEntry, location: str, folder: Path) -> None:
    """Check an output against the data contract before it is published.

    Raises:
        StoreError: An array or a column differs from the contract.
    """
    # Loads zarr and pyarrow, which importing this module must not.
    from nvsf_core.stores.contract_check import contract_faults

    faults = contract_faults(stage.name, location, folder)
    if faults:
        raise StoreError(
            f"scene {scene.name}, stage {stage.name}: not published, for {len(faults)} of its arrays or "
            f"columns are not what docs/data_contract.md says: {'; '.join(faults[:3])}; correct either"
        )


def made_from(stage: Stage, scene: SceneEntry, config: RunConfig, input_fingerprints: dict[str, str]) -> str:
    """SHA-256 of all that decides a stage's output except the recipe."""
    return _without_recipe(_facts(stage, scene, config, input_fingerprints))


def _checked(stage: Stage, task: Task, made: Sequence[Check]) -> dict[str, Any]:
    """The record's entries on checks: those of `run`, replaced or extended by those of `check`.

    Raises:
        UnsoundOutputError: A blocking one failed.
    """
    found = {check.name: check for check in made}
    if stage.check is not None:
        found |= {check.name: check for check in stage.check(task)}
    failed = [check for check in found.values() if check.blocking and not check.passed]
    if failed:
        reasons = "; ".join(f"{check.name}: {check.detail}" for check in failed)
        raise UnsoundOutputError(
            f"scene {task.scene.name}, stage {stage.name}: {reasons}", tuple(found.values())
        )
    return {"checks": [asdict(check) for check in found.values()], "check_version": stage.check_version}


def _checked_again(stage: Stage, task: Task, record: dict[str, Any]) -> dict[str, Any]:
    """The record of a published output; if `check_version` has changed, with the checks made again."""
    if record.get("check_version", "") == stage.check_version:
        return record
    record = record | _checked(stage, task, [Check(**check) for check in record["checks"]])
    write_document(task.folder / RECORD_NAME, record)
    return record


def _outcome(stage: Stage, path: Path, record: dict[str, Any], *, skipped: bool) -> Outcome:
    return Outcome(
        stage=stage.name,
        path=path,
        skipped=skipped,
        seconds=record["seconds"],
        metadata=record["metadata"],
        checks=tuple(Check(**check) for check in record["checks"]),
        previews={name: path / file for name, file in record["previews"].items()},
        fingerprint=record["fingerprint"],
    )


def _digest(facts: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _without_recipe(facts: dict[str, Any]) -> str:
    return _digest({name: fact for name, fact in facts.items() if name != "recipe"})


def _facts(stage: Stage, scene: SceneEntry, config: RunConfig, inputs: dict[str, str]) -> dict[str, Any]:
    """All that decides the output: code version, inputs, scene, recipe and seeds."""
    facts: dict[str, Any] = {
        "stage": stage.name,
        "version": stage.version,
        "inputs": {name: inputs[name] for name in sorted(stage.inputs)},
        "scene": {k: str(v) for k, v in asdict(scene).items() if k not in ("views", "recipe")},
    }
    if stage.per_recipe:
        facts["recipe"] = config.recipe.identity()
        facts["seed"] = config.seed
    if stage.per_draw:
        facts["draw"] = [config.draw_seed, config.dataset_label]
    if stage.reads_views:
        facts["views"] = [str(asdict(view)) for view in scene.views]
    if stage.reads_drive:
        facts["drive"] = drive_listing(scene)
    if stage.reads_truth:
        facts["truth"] = truth_listing(scene)
    return facts
