"""Make a Dagster asset, with its checks and metadata, from a stage of the flow."""

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
"""Every asset's blocking check: it sums up all checks of the stage and lists them in its metadata. Each of
the stage's named checks is also a Dagster check of its own."""
_PUBLISHED = dg.AssetCheckSeverity.WARN
"""A published output passed its blocking checks, so other failures only warn and later stages still run."""
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
    """One asset per stage of the group, in the flow's order."""
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
    """The check that sums up the stage, and one check for each of its named checks."""
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
    """Keyword arguments of an `AssetCheckResult` (or evaluation) per check of a published output."""
    whole = {
        "check_name": CHECK_NAME,
        "passed": all(check.passed for check in outcome.checks),
        "severity": _PUBLISHED,
        "description": f"scene {scene}",
        "metadata": check_metadata(outcome),
    }
    found = {check.name: check for check in outcome.checks}
    return [whole, *(_verdict(named, found.get(named.name), scene) for named in stage.named_checks)]


def reason_of(error: Exception, stage: Stage, scene: str) -> str:
    """The error's message without scene and stage, which are shown beside it."""
    return str(error).removeprefix(f"scene {scene}, stage {stage.name}: ")


def failed_verdicts(stage: Stage, scene: str, error: Exception, reason: str) -> list[dict[str, Any]]:
    """As `verdicts`, for a stage that published nothing: the failure, and the checks that ran before it."""
    whole = {"check_name": CHECK_NAME, "passed": False, "description": f"scene {scene}: {reason}"}
    judged = error.checks if isinstance(error, UnsoundOutputError) else ()
    found = {check.name: check for check in judged}
    return [
        whole,
        *(_verdict(named, found[named.name], scene) for named in stage.named_checks if named.name in found),
    ]


def _verdict(named: NamedCheck, check: Check | None, scene: str) -> dict[str, Any]:
    """As `verdicts`, of one named check. Value and limit are numbers, so that the UI plots them over time."""
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


def outcome_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """Metadata of an output for the UI: path, seconds, its numbers and its preview pictures."""
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
    """Name of each check to its verdict and detail."""
    return {
        check.name: dg.MetadataValue.text(f"{'holds' if check.passed else 'FAILS'}: {check.detail}")
        for check in outcome.checks
    }


def scalar_metadata(values: Mapping[str, float | int | str | bool]) -> dict[str, dg.MetadataValue]:
    """Convert plain values to Dagster's typed metadata values."""
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
    """A PNG file as inline markdown. The event log stores it, so of a large file only the path is given."""
    content = read_picture(path)
    if content is None:
        return dg.MetadataValue.text(f"no picture at {path}")
    if len(content) > _PREVIEW_LIMIT_BYTES:
        return dg.MetadataValue.path(str(path))
    return dg.MetadataValue.md(f"![{path.stem}](data:image/png;base64,{base64.b64encode(content).decode()})")


def events_of(
    stage: Stage, outcome: Outcome, scene: str
) -> Iterable[dg.AssetMaterialization | dg.AssetCheckEvaluation]:
    """Events that an op logs so that Dagster counts the scene's partition as made, with its checks."""
    yield dg.AssetMaterialization(
        asset_key=outcome.stage,
        partition=scene,
        metadata=outcome_metadata(outcome),
    )
    yield from _evaluations(stage, verdicts(stage, outcome, scene))


def failed_checks(
    stage: Stage, scene: str, error: Exception, reason: str
) -> Iterable[dg.AssetCheckEvaluation]:
    """Events that an op logs for a stage that failed with `error` and published nothing."""
    yield from _evaluations(stage, failed_verdicts(stage, scene, error, reason))


def _evaluations(stage: Stage, found: Iterable[dict[str, Any]]) -> Iterator[dg.AssetCheckEvaluation]:
    blocking = {named.name for named in stage.named_checks if named.blocking} | {CHECK_NAME}
    for verdict in found:
        yield dg.AssetCheckEvaluation(
            asset_key=dg.AssetKey(stage.name), blocking=verdict["check_name"] in blocking, **verdict
        )
