"""From a stage of the flow to an asset of the lineage."""

import base64
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import dagster as dg

from assets.workspace import Workspace, catalogue
from nvsf_core.errors import NvsfError
from nvsf_core.stages import STAGES, Check, Outcome, Stage, run_named_stage
from nvsf_core.stages.runner.stage import NOT_RUN, NamedCheck, UnsoundOutputError
from nvsf_core.stores.documents import read_picture

CHECK_NAME = "output_is_sound"
"""Every asset's blocking check: all that the stage itself checked, each listed in the metadata. What a stage
names is a check of its own beside it."""
_PUBLISHED = dg.AssetCheckSeverity.WARN
"""What was published failed no blocking check: another that it fails warns, and what reads it still runs."""
_PREVIEW_LIMIT_BYTES = 100_000
_AssetEvent = dg.AssetCheckResult | dg.MaterializeResult
_KINDS = {
    "frames": ("parquet",),
    "field": ("torch",),
    "scene_metrics": ("parquet",),
    "dataset": ("python",),
}

scene_partitions = dg.StaticPartitionsDefinition([entry.name for entry in catalogue()])


def assets_of_group(group: str) -> list[dg.AssetsDefinition]:
    """The assets of every stage of one group, in the flow's order."""
    return [asset_of(stage) for stage in STAGES if stage.group == group]


def asset_of(stage: Stage, stages: Sequence[Stage] = STAGES) -> dg.AssetsDefinition:
    """An asset, partitioned by scene, that runs the stage or skips what is up to date."""

    @dg.asset(
        name=stage.name,
        deps=list(stage.inputs),
        group_name=stage.group,
        description=stage.description,
        code_version=stage.version,
        partitions_def=scene_partitions,
        kinds=set(_KINDS.get(stage.name, ("zarr",))),
        check_specs=check_specs(stage),
        op_tags={"stage": stage.name},
    )
    def run(context: dg.AssetExecutionContext, workspace: Workspace) -> Iterator[_AssetEvent]:
        scene_run = workspace.plan(context.partition_key)
        try:
            outcome = run_named_stage(stage.name, scene_run, context.log.info, stages=stages)
        except NvsfError as error:
            # Yielded, not logged: what is logged is lost when the step then fails.
            for verdict in failed_verdicts(
                stage, context.partition_key, error, reason_of(error, stage, context.partition_key)
            ):
                yield dg.AssetCheckResult(**verdict)
            raise
        yield dg.MaterializeResult(
            metadata=outcome_metadata(outcome),
            check_results=[
                dg.AssetCheckResult(**verdict) for verdict in verdicts(stage, outcome, context.partition_key)
            ],
        )

    return run


def check_specs(stage: Stage) -> list[dg.AssetCheckSpec]:
    """One check over all that the stage checked, and one for each of its laws."""
    whole = dg.AssetCheckSpec(
        CHECK_NAME,
        asset=stage.name,
        blocking=True,
        description="What the stage checked of its output; with a failed blocking one nothing is published.",
    )
    return [
        whole,
        *(
            dg.AssetCheckSpec(
                named.name, asset=stage.name, blocking=named.blocking, description=named.description
            )
            for named in stage.named_checks
        ),
    ]


def verdicts(stage: Stage, outcome: Outcome, scene: str) -> list[dict[str, Any]]:
    """Arguments of each check's result or evaluation, for a stage's published output."""
    whole = {
        "check_name": CHECK_NAME,
        "passed": is_sound(outcome),
        "severity": _PUBLISHED,
        "description": f"scene {scene}",
        "metadata": check_metadata(outcome),
    }
    found = {check.name: check for check in outcome.checks}
    return [whole, *(_verdict(named, found.get(named.name), scene) for named in stage.named_checks)]


def reason_of(error: Exception, stage: Stage, scene: str) -> str:
    """What an error says, without the scene and stage that the reader is told beside it."""
    return str(error).removeprefix(f"scene {scene}, stage {stage.name}: ")


def failed_verdicts(stage: Stage, scene: str, error: Exception, reason: str) -> list[dict[str, Any]]:
    """The same for a stage that published nothing: that it failed, and what was judged before it did."""
    whole = {"check_name": CHECK_NAME, "passed": False, "description": f"scene {scene}: {reason}"}
    judged = error.checks if isinstance(error, UnsoundOutputError) else ()
    found = {check.name: check for check in judged}
    return [
        whole,
        *(_verdict(named, found[named.name], scene) for named in stage.named_checks if named.name in found),
    ]


def _verdict(named: NamedCheck, check: Check | None, scene: str) -> dict[str, Any]:
    """One check's: value and limit are numbers, so that the UI plots them over time."""
    if check is None:
        reason = f"{NOT_RUN}: this output was made before the check was"
        return {"check_name": named.name, "passed": True, "description": f"scene {scene}: {reason}"}
    numbers = {"value": check.value, "limit": check.limit}
    # A NaN cannot travel to the UI as a number; the description says it.
    metadata: dict[str, dg.MetadataValue] = {
        key: dg.MetadataValue.float(float(number))
        for key, number in numbers.items()
        if number is not None and math.isfinite(number)
    }
    if metadata and check.unit:
        metadata["unit"] = dg.MetadataValue.text(check.unit)
    return {
        "check_name": named.name,
        "passed": check.passed,
        "severity": dg.AssetCheckSeverity.ERROR if named.blocking else dg.AssetCheckSeverity.WARN,
        "description": f"scene {scene}: {check.detail}",
        "metadata": metadata | {"scene": dg.MetadataValue.text(scene)},
    }


def is_sound(outcome: Outcome) -> bool:
    """Whether every check of the stage holds."""
    return all(check.passed for check in outcome.checks)


def outcome_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """What the UI shows of an output: where it lies, how long it took, its numbers and pictures."""
    metadata: dict[str, dg.MetadataValue] = {
        "path": dg.MetadataValue.path(str(outcome.path)),
        "seconds": dg.MetadataValue.float(round(float(outcome.seconds), 3)),
        "was_up_to_date": dg.MetadataValue.bool(outcome.skipped),
    }
    metadata |= scalar_metadata(outcome.metadata)
    for name, path in outcome.previews.items():
        metadata[f"preview_{name}"] = picture(path)
    return metadata


def check_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """Each check with its verdict and its numbers."""
    return {
        check.name: dg.MetadataValue.text(f"{'holds' if check.passed else 'FAILS'}: {check.detail}")
        for check in outcome.checks
    }


def scalar_metadata(values: Mapping[str, float | int | str | bool]) -> dict[str, dg.MetadataValue]:
    """Plain values as Dagster's typed ones."""
    typed: dict[str, dg.MetadataValue] = {}
    for name, value in values.items():
        if isinstance(value, bool):
            typed[name] = dg.MetadataValue.bool(value)
        elif isinstance(value, int):
            typed[name] = dg.MetadataValue.int(value)
        elif isinstance(value, float):
            typed[name] = dg.MetadataValue.float(value)
        else:
            typed[name] = dg.MetadataValue.text(str(value))
    return typed


def picture(path: Path) -> dg.MetadataValue:
    """A PNG as markdown; it is kept in the event log, so a large one is named instead of shown."""
    content = read_picture(path)
    if content is None:
        return dg.MetadataValue.text(f"no picture at {path}")
    if len(content) > _PREVIEW_LIMIT_BYTES:
        return dg.MetadataValue.path(str(path))
    return dg.MetadataValue.md(f"![{path.stem}](data:image/png;base64,{base64.b64encode(content).decode()})")


def events_of(
    stage: Stage, outcome: Outcome, scene: str
) -> Iterable[dg.AssetMaterialization | dg.AssetCheckEvaluation]:
    """What an op logs so that the scene's partition of the asset turns green, with its checks."""
    yield dg.AssetMaterialization(
        asset_key=outcome.stage,
        partition=scene,
        metadata=outcome_metadata(outcome),
    )
    yield from _evaluations(stage, verdicts(stage, outcome, scene))


def failed_checks(
    stage: Stage, scene: str, error: Exception, reason: str
) -> Iterable[dg.AssetCheckEvaluation]:
    """What an op logs of a stage that published nothing, and of the error that kept it from it."""
    yield from _evaluations(stage, failed_verdicts(stage, scene, error, reason))


def _evaluations(stage: Stage, found: Iterable[dict[str, Any]]) -> Iterator[dg.AssetCheckEvaluation]:
    blocking = {named.name for named in stage.named_checks if named.blocking} | {CHECK_NAME}
    for verdict in found:
        yield dg.AssetCheckEvaluation(
            asset_key=dg.AssetKey(stage.name), blocking=verdict["check_name"] in blocking, **verdict
        )
