"""Make a Dagster asset, with its checks and metadata, from a stage of the flow."""

import datetime
from collections.abc import Iterable, Iterator, Sequence

import dagster as dg

from assets.automation import CATALOGUE_TAGS, KEPT, follows_its_scene, seed_of_samples
from assets.drives import ASKED_VIEWS, DRIVE
from assets.json_lines import log_as_json
from assets.metadata import outcome_metadata
from assets.origin import say_whose_run_it_is
from assets.scenes import DATA_VERSION, OWNERS, SCENES, key_of
from assets.schema import schema_metadata
from assets.verdicts import check_specs, evaluations, failed_verdicts, reason_of, verdicts
from assets.workspace import Workspace
from nvsf_core.errors import CatalogueError, NvsfError
from nvsf_core.stages import STAGES, Outcome, Stage

_AssetEvent = dg.AssetCheckResult | dg.MaterializeResult
_KINDS = {
    "frames": ("parquet",),
    "evidence": ("zarr", "numba"),
    "field": ("torch", "safetensors"),
    "mesh": ("zarr", "open3d"),
    "novel_views": ("zarr", "png"),
    "scene_metrics": ("parquet",),
    "dataset": ("pointcloud", "png", "json"),
}
DEVICE_POOL = "device"
"""Pool of what trains in runs of assets: the UI shows what waits for it. The lock of the device keeps all
trainings apart, also those of `train_all_scenes`, whose ops are in no pool; who waits for it says so."""
FRESH = dg.FreshnessPolicy.time_window(
    fail_window=datetime.timedelta(days=8), warn_window=datetime.timedelta(days=7, hours=12)
)
"""Of what the weekly schedule makes."""
_RETRY_KILLED = dg.RetryPolicy(max_retries=1)
"""A step whose process died is tried once more, from its last checkpoint; errors of a stage are not."""


def assets_of_group(group: str) -> list[dg.AssetsDefinition]:
    """One asset per stage of the group, in the flow's order."""
    return [asset_of(stage) for stage in STAGES if stage.group == group]


def asset_of(stage: Stage, stages: Sequence[Stage] = STAGES) -> dg.AssetsDefinition:
    """An asset, partitioned by scene, that runs the stage or skips what is up to date."""

    @dg.asset(
        key=key_of(stage.name),
        deps=inputs_of(stage),
        group_name=stage.group,
        description=stage.description,
        code_version=stage.version,
        partitions_def=SCENES,
        backfill_policy=dg.BackfillPolicy.multi_run(max_partitions_per_run=1),
        automation_condition=follows_its_scene(),
        freshness_policy=FRESH if stage.per_draw else None,
        pool=DEVICE_POOL if stage.group == "train" else None,
        owners=OWNERS,
        kinds=set(_KINDS.get(stage.name, ("zarr",))),
        metadata=schema_metadata(stage.name),
        check_specs=check_specs(stage),
        retry_policy=_RETRY_KILLED,
        op_tags={"stage": stage.name},
    )
    def run(context: dg.AssetExecutionContext, workspace: Workspace) -> Iterator[_AssetEvent]:
        scene = context.partition_key
        say_whose_run_it_is(context.instance, context.run.run_id)
        log_as_json(context)
        try:
            outcome = workspace.run_stage(
                stage.name, scene, context.log.info, stages=stages, keep=KEPT in context.run.tags,
                draw_seed=seed_of_samples(context.run),
            )  # fmt: skip
        except NvsfError as error:
            if isinstance(error, CatalogueError):
                context.instance.add_run_tags(context.run.run_id, CATALOGUE_TAGS)
            # Yielded, not logged: what is logged is lost when the step then fails.
            reason = reason_of(error, stage, scene)
            for verdict in failed_verdicts(stage, scene, error, reason):
                yield dg.AssetCheckResult(**verdict)
            raise dg.Failure(description=str(error), allow_retries=False) from error
        yield dg.MaterializeResult(
            metadata=outcome_metadata(outcome),
            data_version=dg.DataVersion(outcome.content),
            check_results=[dg.AssetCheckResult(**verdict) for verdict in verdicts(stage, outcome, scene)],
        )

    return run


def observed_by(stage: Stage) -> list[str]:
    """Observed assets that a stage reads."""
    views = stage.reads_views or stage.reads_truth
    return [DRIVE] * stage.reads_drive + [ASKED_VIEWS] * views


def inputs_of(stage: Stage) -> list[dg.AssetKey]:
    """Assets that a stage reads."""
    return [key_of(name) for name in (*stage.inputs, *observed_by(stage))]


def events_of(
    stage: Stage, outcome: Outcome, scene: str, instance: dg.DagsterInstance, inputs: dict[str, str]
) -> Iterable[dg.AssetMaterialization | dg.AssetCheckEvaluation]:
    """Events that an op logs, one by one, so that Dagster counts the scene's partition as made and checked.

    The verdicts name the first event, which must have been logged before the next one is asked for.

    Args:
        stage: The stage.
        outcome: What came of it.
        scene: Name of the scene.
        instance: Has the events of earlier outputs.
        inputs: Tags that say what it is made of, asked for before it was made.
    """
    yield dg.AssetMaterialization(
        asset_key=key_of(outcome.stage),
        partition=scene,
        metadata=outcome_metadata(outcome),
        tags={DATA_VERSION: outcome.content, **inputs},
    )
    yield from evaluations(stage.name, scene, verdicts(stage, outcome, scene), instance)


def failed_checks(
    stage: Stage, scene: str, error: Exception, reason: str, instance: dg.DagsterInstance
) -> Iterable[dg.AssetCheckEvaluation]:
    """Events that an op logs for a stage that failed and published nothing.

    Args:
        stage: The stage.
        scene: Name of the scene.
        error: What it failed with.
        reason: The error in words, without scene and stage.
        instance: Has the events of earlier outputs.
    """
    yield from evaluations(stage.name, scene, failed_verdicts(stage, scene, error, reason), instance)
