"""From a stage of the flow to an asset of the lineage."""

import base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import dagster as dg

from assets.workspace import Workspace, catalogue
from nvsf_core.errors import NvsfError
from nvsf_core.stages import STAGES, Outcome, Stage, run_named_stage

CHECK_NAME = "output_is_sound"
"""Every asset's blocking check: all that the stage itself checked, each listed in the metadata."""
_PUBLISHED = dg.AssetCheckSeverity.WARN
"""What was published broke no blocking law: a law that it breaks warns, and what reads it still runs."""
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
        check_specs=[
            dg.AssetCheckSpec(
                CHECK_NAME,
                asset=stage.name,
                blocking=True,
                description="What the stage checked of its output; a failed blocking law publishes nothing.",
            )
        ],
        op_tags={"stage": stage.name},
    )
    def run(context: dg.AssetExecutionContext, workspace: Workspace) -> Iterator[_AssetEvent]:
        scene_run = workspace.plan(context.partition_key)
        try:
            outcome = run_named_stage(stage.name, scene_run, context.log.info, stages=stages)
        except NvsfError as error:
            # Yielded, not logged: what is logged is lost when the step then fails.
            yield dg.AssetCheckResult(
                check_name=CHECK_NAME, passed=False, description=f"scene {context.partition_key}: {error}"
            )
            raise
        yield dg.MaterializeResult(
            metadata=outcome_metadata(outcome),
            check_results=[
                dg.AssetCheckResult(
                    check_name=CHECK_NAME,
                    passed=is_sound(outcome),
                    severity=_PUBLISHED,
                    description=f"scene {context.partition_key}",
                    metadata=check_metadata(outcome),
                )
            ],
        )

    return run


def is_sound(outcome: Outcome) -> bool:
    """Whether every law that the stage checked holds."""
    return all(check.passed for check in outcome.checks)


def outcome_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """What the UI shows of an output: where it lies, how long it took, its numbers and pictures."""
    metadata: dict[str, dg.MetadataValue] = {
        "path": dg.MetadataValue.path(str(outcome.path)),
        "seconds": dg.MetadataValue.float(round(outcome.seconds, 3)),
        "was_up_to_date": dg.MetadataValue.bool(outcome.skipped),
    }
    metadata |= scalar_metadata(outcome.metadata)
    for name, path in outcome.previews.items():
        metadata[f"preview_{name}"] = picture(path)
    return metadata


def check_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """Each law with its verdict and its numbers."""
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
    if not path.is_file():
        return dg.MetadataValue.text(f"no picture at {path}")
    content = path.read_bytes()
    if len(content) > _PREVIEW_LIMIT_BYTES:
        return dg.MetadataValue.path(str(path))
    return dg.MetadataValue.md(f"![{path.stem}](data:image/png;base64,{base64.b64encode(content).decode()})")


def events_of(outcome: Outcome, scene: str) -> Iterable[dg.AssetMaterialization | dg.AssetCheckEvaluation]:
    """What an op logs so that the scene's partition of the asset turns green, with its check."""
    yield dg.AssetMaterialization(
        asset_key=outcome.stage,
        partition=scene,
        metadata=outcome_metadata(outcome),
    )
    yield dg.AssetCheckEvaluation(
        asset_key=dg.AssetKey(outcome.stage),
        check_name=CHECK_NAME,
        passed=is_sound(outcome),
        severity=_PUBLISHED,
        description=f"scene {scene}",
        metadata=check_metadata(outcome),
        blocking=True,
    )


def failed_check(stage_name: str, scene: str, reason: str) -> dg.AssetCheckEvaluation:
    """The failed check of a stage that published nothing."""
    return dg.AssetCheckEvaluation(
        asset_key=dg.AssetKey(stage_name),
        check_name=CHECK_NAME,
        passed=False,
        description=f"scene {scene}: {reason}",
        blocking=True,
    )
