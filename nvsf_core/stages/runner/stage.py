"""What a stage is, and how one is run: skipped when nothing changed, published whole when it ran."""

import hashlib
import json
import os
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
from nvsf_core.stages.runner.record import RECORD_NAME, damage_of, listed_files, read_record
from nvsf_core.stores.documents import write_document
from nvsf_core.stores.scene_store import SceneStore

NOT_RUN = "not run"
"""How the detail of a check begins that had nothing to judge."""
_MOST_FILES = 500_000
"""Of one sequence: KITTI-360's longest has 15,000 frames of five sensors."""


class Progress(Protocol):
    """Takes one line a time for the person who waits."""

    def __call__(self, line: str, /) -> None:
        """Say `line`."""


class Observer(Protocol):
    """Watches a training from outside, for example to score it at given seconds."""

    def __call__(self, part: str, state: Any, /) -> None:
        """See a part of the model after one of its steps.

        Args:
            part: Name of the checkpoint's file: `lidar`, `camera`, ...
            state: A `nvsf_core.training.loop.TrainingState`, not to be changed. (Its module loads torch,
                which importing this one must not.)
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """What a run was asked for, beside the scene."""

    recipe: Recipe
    """What is trained and rendered."""
    seed: int = 0
    """Seed of training."""
    draw_seed: int = 0
    """Seed of what is random in a data set: ray drop and range noise."""
    dataset_label: str = "manual"
    """First part of a data set's version: an ISO week, or `manual`."""

    def __post_init__(self) -> None:
        """Refuse what is no seed, and a label that is no part of a folder's name."""
        require_seed(self.seed)
        require_seed(self.draw_seed, "draw_seed")
        fault = name_fault(self.dataset_label)
        if fault is not None:
            raise DataError(f"dataset_label: {fault}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """The outcome of one check of a stage's output."""

    name: str
    """A law in snake_case, for example `all_frames_have_a_pose`."""
    passed: bool
    """Whether it holds."""
    detail: str
    """What was found, with numbers."""
    blocking: bool = False
    """A failed blocking check keeps the output from being published."""
    value: float | None = None
    """The number that was judged; None where the law has none, or could not be measured."""
    limit: float | None = None
    """What `value` may at most be."""
    unit: str = ""
    """Of both; empty for shares and counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedCheck:
    """A check that a stage makes of every scene: the UI and the report show it by itself."""

    name: str
    """As of the check."""
    description: str
    """What it asks, why, and where its limit is from."""
    blocking: bool = False
    """Whether what breaks it is unusable; else breaking it is a doubt, and warns."""

    def outcome(self, value: float, limit: float, detail: str, unit: str = "") -> Check:
        """The law's check: it holds where the value is at most the limit; NaN breaks it."""
        return Check(
            name=self.name, passed=value <= limit, detail=detail, blocking=self.blocking, value=value,
            limit=limit, unit=unit,
        )  # fmt: skip

    def not_run(self, reason: str) -> Check:
        """The law's check on an output that has nothing to be judged by."""
        return Check(name=self.name, passed=True, detail=f"{NOT_RUN}: {reason}", blocking=self.blocking)


class UnsoundOutputError(CheckFailedError):
    """Blocking checks failed; carries all checks of the output."""

    def __init__(self, message: str, checks: Sequence[Check]) -> None:
        """Say which failed; keep what all of them found."""
        super().__init__(message)
        self.checks = tuple(checks)


@dataclass(slots=True, kw_only=True)
class StageOutput:
    """What a stage says of what it made."""

    metadata: dict[str, Scalar] = field(default_factory=dict)
    """Numbers and words for tables and the UI, units in the keys."""
    checks: list[Check] = field(default_factory=list)
    """Outcomes of the stage's checks."""
    previews: dict[str, str] = field(default_factory=dict)
    """Name to file name of PNG pictures inside the output folder, each below 100 kB."""
    beside: list[str] = field(default_factory=list)
    """Outputs that it published beside its own folder, by their place below the scene's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """All that a stage's `run` may know."""

    scene: SceneEntry
    store: SceneStore
    config: RunConfig
    folder: Path
    """Empty folder to fill; published whole when `run` returns."""
    progress: Progress
    observe: Observer | None = None
    """Watches the training; the clock stands still meanwhile."""
    made_from: str = ""
    """`made_from` of the stage and its inputs: tells checkpoints of other inputs apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One step of the flow and one asset of the lineage."""

    name: str
    group: str
    """ingest, prepare, train, synthesis or report: the asset group."""
    inputs: tuple[str, ...]
    """Names of the stages whose outputs it reads."""
    description: str
    """One sentence on what the thing is, shown in the UI."""
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
    """Whether the views that are asked for are part of its identity."""
    check: Callable[[Task], list[Check]] | None = None
    """Judges what lies in the task's folder, just made or published earlier."""
    check_version: str = ""
    """Raised when `check` judges otherwise: outputs that are up to date are judged again, not made again."""
    named_checks: tuple[NamedCheck, ...] = ()
    """The checks, of `run` or `check`, that are shown by themselves."""

    def location(self, config: RunConfig) -> str:
        """Where its output lies under the scene's folder."""
        if not self.per_recipe:
            return self.name
        if self.per_draw:
            # Its versions lie beside each other under its name; the record of a draw must not mix with them.
            draw = f"{config.seed}-{config.draw_seed}-{config.dataset_label}"
            return f"{self.name}/.index/{config.recipe.name}/{draw}"
        return f"{self.name}/{config.recipe.name}/{config.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One stage's run on one scene."""

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
    """Run one stage, or skip it when its code, configuration and inputs are unchanged.

    An output whose files are no longer those that were published is made again. Inputs are held against
    their records before they are read: a flipped byte is never trained on.

    Args:
        stage: What to run.
        scene: On which drive.
        store: Where outputs lie.
        config: What was asked for.
        progress: Takes lines for the person who waits.
        input_fingerprints: Name of each input stage to the fingerprint of its output.
        input_locations: Where these outputs lie below the scene's folder.

    Raises:
        StoreError: An input is not what was published.
        UnsoundOutputError: A blocking check failed; nothing was published.
        NvsfError: Whatever the stage itself raises.
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
        record = _judged_again(stage, task(store.path(location)), record)
        return _outcome(stage, store.path(location), record, skipped=True)
    for place in input_locations:
        damage = damage_of(store, place, read_record(store.require(place)) or {})
        if damage is not None:
            raise StoreError(f"{damage} is not what was published; run the stage {place.split('/')[0]} again")
    progress(f"[{scene.name}] {stage.name}: started")
    started = time.perf_counter()
    with store.publish(location) as folder:
        output = stage.run(task(folder))
        _require_contract(stage, scene, location, folder)
        record = {
            "fingerprint": fingerprint,
            "version": stage.version,
            "metadata": output.metadata,
            "previews": output.previews,
            **_judged(stage, task(folder), output.checks),
            "seconds": time.perf_counter() - started,
            "files": listed_files(store, folder, output.previews.values(), output.beside),
        }
        write_document(folder / RECORD_NAME, record)
    progress(f"[{scene.name}] {stage.name}: done in {record['seconds']:.1f} s")
    return _outcome(stage, store.path(location), record, skipped=False)


def _require_contract(stage: Stage, scene: SceneEntry, location: str, folder: Path) -> None:
    """Refuse to publish what readers would not take.

    Raises:
        StoreError: An array or a column is not what the data contract says.
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
    """SHA-256 of all that decides a stage's output but the recipe."""
    return _without_recipe(_facts(stage, scene, config, input_fingerprints))


def _judged(stage: Stage, task: Task, made: Sequence[Check]) -> dict[str, Any]:
    """The record's part on checks: those that `run` made, and over them what `check` finds in the folder.

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


def _judged_again(stage: Stage, task: Task, record: dict[str, Any]) -> dict[str, Any]:
    """The record of a published output, judged anew where it was judged by earlier checks."""
    if record.get("check_version", "") == stage.check_version:
        return record
    record = record | _judged(stage, task, [Check(**check) for check in record["checks"]])
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
    """All that decides the output."""
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
        facts["drive"] = _drive_listing(scene)
    return facts


def _drive_listing(scene: SceneEntry) -> str:
    """Names, sizes and change times of the drive's files: cheap, and different when a file is.

    Raises:
        DataError: There are too many: a link leads to where there is no drive.
    """
    digest = hashlib.sha256()
    folders = [scene.root / "calibration"] + [
        scene.root / kind / scene.sequence for kind in ("data_3d_raw", "data_2d_raw", "data_poses")
    ]
    files = [path for folder in folders for path in _files_below(folder)]
    files += sorted((scene.root / "data_3d_bboxes").glob(f"*/{scene.sequence}.xml"))
    for path in files:
        if path.is_file():
            stat = path.stat()
            name = path.relative_to(scene.root).as_posix()
            digest.update(os.fsencode(f"{name} {stat.st_size} {stat.st_mtime_ns}\n"))
    return digest.hexdigest()


def _files_below(folder: Path) -> list[Path]:
    """All files below a folder, in the order of their paths."""
    found: list[Path] = []
    for place, _, names in os.walk(folder):
        found += [Path(place) / name for name in names]
        if len(found) > _MOST_FILES:
            raise DataError(
                f"{folder}: expected the files of one drive, found more than {_MOST_FILES:,}; is it a link "
                "to another place?"
            )
    return sorted(found)
