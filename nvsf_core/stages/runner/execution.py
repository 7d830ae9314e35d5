"""How one stage is run: skipped if nothing that it is made from changed, else published whole."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import DataError, StoreError
from nvsf_core.stages.optional_tools import tools_now_there
from nvsf_core.stages.runner.contents import hashes_of
from nvsf_core.stages.runner.facts import Facts, difference, facts_of, without_recipe
from nvsf_core.stages.runner.record import (
    RECORD_NAME,
    content_of,
    damage_of,
    listed_files,
    read_record,
    removals_of,
)
from nvsf_core.stages.runner.resources import Meter, in_words, keep_freed_memory, require_space
from nvsf_core.stages.runner.stage import (
    Check,
    Later,
    Outcome,
    Progress,
    RunConfig,
    Stage,
    Task,
    UnsoundOutputError,
)
from nvsf_core.stores.checksums import json_digest
from nvsf_core.stores.documents import write_document
from nvsf_core.stores.file_hashes import FileHashes
from nvsf_core.stores.scene_store import SceneStore


@dataclass(frozen=True, slots=True, kw_only=True)
class StagePlace:
    """A stage on a scene: where its output and its inputs lie, and what they are made with."""

    stage: Stage
    scene: SceneEntry
    store: SceneStore
    config: RunConfig
    inputs: Mapping[str, str]
    """Name of each input stage to the path of its output below the scene's folder."""

    @property
    def location(self) -> str:
        """Path of the output below the scene's folder."""
        return self.stage.location(self.config)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Whether a stage's output is up to date, and what it is compared by."""

    record: dict[str, Any] | None
    """Its record; None if there is none, or a damaged one."""
    facts: Facts
    """All that decides the output now."""
    reason: str
    """Why it has to be made again; empty if it is up to date or was never made."""
    is_up_to_date: bool


def compared(place: StagePlace, hashes: FileHashes) -> Comparison:
    """Compare what a published output was made from with what is there now; its own files are not read.

    Raises:
        StoreError: An input was never published.
        DataError: A recorded file cannot be read.
        TimeIsUpError: The time of `hashes` is up.
    """
    contents = {name: content_of(record) for name, record in _input_records(place).items()}
    facts = facts_of(place.stage, place.scene, place.config, contents, hashes)
    record = read_record(place.store.recovered(place.location))
    if record is None:
        return Comparison(record=None, facts=facts, reason="", is_up_to_date=False)
    if record["fingerprint"] == json_digest(facts):
        tools = tools_now_there(record["metadata"].values())
        reason = f"for {', '.join(tools)}, absent when it was made, can be used now" if tools else ""
        return Comparison(record=record, facts=facts, reason=reason, is_up_to_date=not tools)
    reason = f"for {difference(record['facts'], facts)} changed"
    return Comparison(record=record, facts=facts, reason=reason, is_up_to_date=False)


class DamagedInputError(StoreError):
    """The files of an input have changed since it was published, or its record cannot be read."""

    def __init__(self, message: str, stage: str) -> None:
        """Take the message, and the name of the stage that makes the input."""
        super().__init__(message)
        self.stage = stage


def skipped_stage(place: StagePlace, progress: Progress) -> Outcome | None:
    """The outcome of a stage whose output is up to date and as it was published; None if it must be made.

    Raises:
        StoreError: An input was never published.
        DamagedInputError: The record of an input cannot be read.
        DataError: A recorded file cannot be read.
    """
    found = _compared(place)
    if not found.is_up_to_date or found.record is None:
        return None
    if damage_of(place.store, place.location, found.record) is not None:
        return None
    name, path = f"[{place.scene.name}] {place.stage.name}", place.store.path(place.location)
    progress(f"{name}: up to date, skipped")
    for one in removals_of(place.store, found.record):
        progress(f"{name}: {one.place} was {one.words}; delete {one.note} and run again to have it")
    task = _task(place, found, path, progress)
    record = _checked_again(place.stage, task, found.record)
    return outcome_of(place.stage, path, record, skipped=True)


def run_stage(place: StagePlace, progress: Progress) -> Outcome:
    """Make a stage's output, unless it is up to date and as it was published.

    Input files are compared with their checksums first, so that damaged data are never used.

    Raises:
        DamagedInputError: The files of an input have changed since it was published.
        DataError: A recorded file changed while it was read.
        UnsoundOutputError: A blocking check failed; nothing was published.
        NvsfError: The stage failed.
    """
    outcome = skipped_stage(place, progress)
    if outcome is not None:
        return outcome
    found = _compared(place)

    def task(folder: Path) -> Task:
        return _task(place, found, folder, progress)

    stage, store, name = place.stage, place.store, f"[{place.scene.name}] {place.stage.name}"
    path, reason = store.path(place.location), found.reason
    if found.is_up_to_date and found.record is not None:
        reason = f"{damage_of(store, place.location, found.record)} is not what was published"
    if reason:
        progress(f"{name}: made again, {reason}")
    _require_sound_inputs(place)
    require_space(stage, task(path))
    progress(f"{name}: started")
    record = _publish(place, found, task)
    # Not sooner: what stops a stage in its last minute must not cost the hours before.
    store.drop_work_dir(place.location)
    progress(f"{name}: done in {record['seconds']:.1f} s, {in_words(record['resources'])}")
    return outcome_of(stage, path, record, skipped=False)


def _compared(place: StagePlace) -> Comparison:
    with hashes_of(place.store) as hashes:
        return compared(place, hashes)


def _task(place: StagePlace, found: Comparison, folder: Path, progress: Progress) -> Task:
    return Task(
        scene=place.scene, store=place.store, config=place.config, folder=folder, progress=progress,
        made_from=without_recipe(found.facts),
    )  # fmt: skip


def made_from(place: StagePlace) -> str:
    """SHA-256 of all that decides a stage's output except the recipe.

    Raises:
        StoreError: An input was never published.
    """
    return without_recipe(_compared(place).facts)


def outcome_of(stage: Stage, path: Path, record: dict[str, Any], *, skipped: bool) -> Outcome:
    """The outcome that a record tells of."""
    return Outcome(
        stage=stage.name,
        path=path,
        skipped=skipped,
        seconds=record["seconds"],
        metadata=record["metadata"],
        checks=tuple(Check(**check) for check in record["checks"]),
        previews={name: path / file for name, file in record["previews"].items()},
        fingerprint=record["fingerprint"],
        content=content_of(record),
        resources=record["resources"],
    )


def _publish(place: StagePlace, found: Comparison, task: Callable[[Path], Task]) -> dict[str, Any]:
    """Make the output and publish it; returns its record."""
    # Here, because it loads torch and numba: asking what is there must not wait for them.
    from nvsf_core.kernels.threads import use_threads

    use_threads()
    keep_freed_memory()
    stage, store = place.stage, place.store
    if isinstance(stage.run, Later):
        stage.run.load()  # the seconds of a stage are those of its work
    started, meter = time.perf_counter(), Meter()
    with store.publish(place.location) as folder:
        output = stage.run(task(folder))
        _require_contract(place, folder)
        _require_unchanged(place, found.facts)
        record = {
            "fingerprint": json_digest(found.facts),
            "facts": found.facts,
            "version": stage.version,
            "metadata": output.metadata,
            "previews": output.previews,
            **_checked(stage, task(folder), output.checks),
            "seconds": time.perf_counter() - started,
            "made_s": time.time(),
            "files": listed_files(store, folder, output.previews.values(), output.beside),
            "resources": meter.taken(),
        }
        write_document(folder / RECORD_NAME, record)
    return record


def _input_records(place: StagePlace) -> dict[str, dict[str, Any]]:
    found = {}
    for name, location in place.inputs.items():
        folder = place.store.require(location)
        record = read_record(folder)
        if record is None:
            words = f"{folder}: expected the record of stage {name}, found none; run that stage"
            raise DamagedInputError(words, name)
        found[name] = record
    return found


def _require_sound_inputs(place: StagePlace) -> None:
    """Refuse inputs whose files are not what was published."""
    for name, location in place.inputs.items():
        damage = damage_of(place.store, location, read_record(place.store.require(location)) or {})
        if damage is not None:
            raise DamagedInputError(f"{damage} is not what was published; run the stage {name} again", name)


def _require_unchanged(place: StagePlace, facts: Facts) -> None:
    """Refuse to publish what was made of a drive that changed meanwhile."""
    if not (place.stage.reads_drive or place.stage.reads_truth):
        return
    contents = facts["inputs"]
    with hashes_of(place.store) as hashes:
        now = facts_of(place.stage, place.scene, place.config, contents, hashes)
    if now != facts:
        raise DataError(
            f"scene {place.scene.name}, stage {place.stage.name}: not published, for "
            f"{difference(facts, now)} under {place.scene.root} changed while they were read; wait until all "
            "is copied, and run again"
        )


def _require_contract(place: StagePlace, folder: Path) -> None:
    """Check an output against the data contract before it is published.

    Raises:
        StoreError: An array or a column differs from the contract.
    """
    # Loads zarr and pyarrow, which importing this module must not.
    from nvsf_core.stores.contract_check import contract_faults

    faults = contract_faults(place.stage.name, place.location, folder)
    if faults:
        raise StoreError(
            f"scene {place.scene.name}, stage {place.stage.name}: not published, for {len(faults)} of its "
            f"arrays or columns are not what docs/data_contract.md says: {'; '.join(faults[:3])}; correct "
            "either"
        )


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
    """The record of a published output; with the checks made again if `check_version` has changed.

    They are, too, if a tool that one of them lacked is there now.
    """
    is_of_now = record["check_version"] == stage.check_version
    lacked = [check["detail"] for check in record["checks"]] if stage.check is not None else []
    if is_of_now and not tools_now_there(lacked):
        return record
    record = record | _checked(stage, task, [Check(**check) for check in record["checks"]])
    write_document(task.folder / RECORD_NAME, record)
    return record
