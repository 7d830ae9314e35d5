"""`train_all_scenes`: every scene through every stage, one report, and a failure that names who failed.

A partitioned asset job would need a partition, which `dagster job execute` cannot name; so this is an op
job, made from the same stages as the assets, that logs each scene's materialisations and checks.
"""

import functools
import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import dagster as dg

# Not exported by Dagster, which logs it of assets alone; Dagster is held below 1.14.
from dagster._core.events import AssetMaterializationPlannedData, DagsterEvent
from pydantic import Field

from assets.drives import newly_seen
from assets.factory import events_of, failed_checks, inputs_of, observed_by
from assets.metadata import exported_folders
from assets.origin import TERMINAL_TAG, say_whose_run_it_is
from assets.provenance import made_of
from assets.report import CURVES, REPORT, report_made_of, report_metadata, scenes_without_data
from assets.scenes import key_of, register
from assets.verdicts import reason_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.drive import has_data, why_no_data
from nvsf_core.errors import CatalogueError, NvsfError, StageKilledError
from nvsf_core.names import printable
from nvsf_core.stages import STAGES, Stage, find_scene
from nvsf_core.stages.flow import SCENE_METRICS
from nvsf_core.stages.runner.failures import remember_failure
from nvsf_core.stages.runner.patience import patiently
from nvsf_core.stages.runner.run import write_demo_where_absent
from nvsf_core.stores.scene_store import SceneStore
from pipelines.closing_words import SceneState, closing_words, next_ui, next_view
from pipelines.failures import CALLED_TAG, call_command, named_command
from pipelines.passed_values import PassedValues, remove_old_values
from pipelines.resources import RESOURCES
from pipelines.terminal import TERSE_LOGGING, terse_logger

# A killed process (out of memory) gets a second try, which resumes from the last checkpoint; the third only
# records that the scene failed: a failed step would prevent the report of all other scenes.
# Errors that a scene raises are caught and recorded; they never lead to a retry.
_RETRY_KILLED = dg.RetryPolicy(max_retries=2)
_KILLED_TWICE = (
    "its process died twice (killed, out of memory, or crashed); the run's log names the signal. Run again "
    "with more memory, or look at what this scene feeds the stage"
)


class SceneChoice(dg.Config):
    """The scenes to train."""

    scenes: list[str] | None = Field(
        default=None,
        description="Names; empty = SCENES (separated by blanks), else all of the catalogue that have data.",
    )


@dg.op(
    out={"scene": dg.DynamicOut(dict), "absent": dg.Out(list)},
    description="Name the scenes: those asked for, else every one that has data; the demo drive is written.",
)
def choose_scenes(context: dg.OpExecutionContext, workspace: Workspace, config: SceneChoice) -> Iterator[Any]:
    """Fan out over the scenes. Without data, one asked for by name counts as failed; others are left out.

    A name that the catalogue has not is a slip of who asked: nothing is started for it.
    """
    say_whose_run_it_is(context.instance, context.run.run_id)
    asked = config.scenes or os.environ.get("SCENES", "").split()
    try:
        workspace.require_possible()
        names = [find_scene(name).name for name in dict.fromkeys(asked)] or [one.name for one in catalogue()]
    except NvsfError as error:
        raise dg.Failure(description=str(error), allow_retries=False) from error
    remove_old_values()
    absent: list[str] = []
    there: list[str] = []
    keys: set[str] = set()
    for name in names:
        failure = _prepare_drive(name, context)
        if failure and not asked:
            absent.append(name)
            context.log.info(f"[{name}] no data, left out: {failure}")
            continue
        # Dagster's mapping keys allow neither `-` nor `.`, and must be unique.
        key = re.sub(r"\W", "_", name, flags=re.ASCII) or "scene"
        while key in keys:
            key += "_"
        keys.add(key)
        if not failure:
            there.append(name)
        state: SceneState = {"scene": name, "failed": failure, "stages": [], "exports": [], "doubts": []}
        yield dg.DynamicOutput(state, mapping_key=key, output_name="scene")
    register(context.instance, there)
    yield dg.Output(absent, output_name="absent")


def _prepare_drive(name: str, context: dg.OpExecutionContext) -> str:
    """Why the scene's drive cannot be used; empty if it can."""
    try:
        entry = patiently(lambda: find_scene(name), context.log.info)
        write_demo_where_absent(entry, context.log.info)
        return "" if has_data(entry) else f"drive: no data at {entry.root}: {why_no_data(entry)}"
    except NvsfError as error:
        return f"drive: {error}"


@functools.cache
def _stage_ops(stages: tuple[Stage, ...]) -> tuple[dg.OpDefinition, ...]:
    """One op per stage, shared by all jobs: a code location refuses two ops of the same name."""
    return tuple(_stage_op(stage, position + 1, stages) for position, stage in enumerate(stages))


def _stage_op(stage: Stage, position: int, stages: Sequence[Stage]) -> dg.OpDefinition:
    # Later stages have priority: a scene is finished before the next one begins.
    @dg.op(
        name=f"{stage.name}_of_scene",
        description=stage.description,
        tags={"dagster/priority": str(position)},
        retry_policy=_RETRY_KILLED,
    )
    def run(context: dg.OpExecutionContext, workspace: Workspace, state: dict) -> dict:
        scene: str = state["scene"]
        if state["failed"]:
            context.log.warning(f"[{scene}] {stage.name}: not run, failed before ({state['failed']})")
            return state
        if context.retry_number >= _RETRY_KILLED.max_retries:  # begun, and said to be, by the first try
            remember_failure(SceneStore(workspace.home(), scene), stage.name, _KILLED_TWICE)
            return _failed(context, state, stage, StageKilledError(_KILLED_TWICE), _KILLED_TWICE)
        _say_that_it_is_begun(context, stage, scene)
        try:
            entry = patiently(lambda: find_scene(scene), context.log.info)
            for seen in newly_seen(context.instance, entry, workspace, observed_by(stage)):
                context.log_event(seen)
            inputs = made_of(context.instance, stage.version, inputs_of(stage), scene)
            outcome = workspace.run_stage(stage.name, scene, context.log.info, stages=stages)
            for event in events_of(stage, outcome, scene, context.instance, inputs):
                context.log_event(event)
        except NvsfError as error:
            return _failed(context, state, stage, error, reason_of(error, stage, scene))
        except Exception as error:
            # A defect of the code; still, a failed step would prevent the report of all scenes.
            context.log.exception(f"[{scene}] {stage.name}: unexpected error")
            return _failed(context, state, stage, error, f"{type(error).__name__}: {error}")
        done = {"stage": stage.name, "seconds": outcome.seconds, "skipped": outcome.skipped}
        exports = [*state["exports"], *map(str, exported_folders(outcome).values())]
        found = [f"{one.name.replace('_', ' ')}: {one.detail}" for one in outcome.checks if not one.passed]
        doubts = [*state["doubts"], *found]
        return {**state, "stages": [*state["stages"], done], "exports": exports, "doubts": doubts}

    return run


def _say_that_it_is_begun(context: dg.OpExecutionContext, stage: Stage, scene: str) -> None:
    """As Dagster says it in a run of assets: the partition is in progress; failed if the run ends without it.

    Else a scene that failed would look like one that was never asked for: its steps are green.
    """
    planned = DagsterEvent.build_asset_materialization_planned_event(
        context.job_name,
        context.get_step_execution_context().step.key,
        AssetMaterializationPlannedData(key_of(stage.name), partition=scene, partitions_subset=None),
    )
    context.instance.report_dagster_event(planned, context.run_id, logging.DEBUG)


def _failed(
    context: dg.OpExecutionContext, state: SceneState, stage: Stage, error: Exception, words: str
) -> SceneState:
    reason = f"{stage.name}: {words}"
    context.log.warning(f"[{state['scene']}] FAILED in {reason}")
    for event in failed_checks(stage, state["scene"], error, reason, context.instance):
        context.log_event(event)
    return {**state, "failed": reason}


@dg.op(
    tags={"dagster/priority": str(len(STAGES))},
    description="One page over every scene measured under NVSF_HOME, and this run's table for the terminal.",
)
def report_all(
    context: dg.OpExecutionContext, workspace: Workspace, states: list[dict], absent: list[str]
) -> list[str]:
    """Make the report, also if scenes failed; returns the failures, one line per scene.

    The page shows everything measured under the home, the table on the terminal only this run.
    """
    # Here, because they load matplotlib, zarr and pyarrow, for which no start of Dagster should wait.
    from nvsf_core.stages.benchmark_report import make_benchmark_report
    from nvsf_core.stores.tables import read_rows

    inputs = report_made_of(context.instance, context.run_id)
    failures = {state["scene"]: state["failed"] for state in states if state["failed"]}
    measured = [state["scene"] for state in states if not state["failed"]]
    named = [state["scene"] for state in states]
    rows, planned = [], []
    try:
        lacking = patiently(lambda: scenes_without_data(workspace.home()), context.log.info)
    except CatalogueError:  # each scene says it below
        lacking = absent
    for scene in measured:
        try:
            run = workspace.plan(scene)
            rows += read_rows(run.store.require(SCENE_METRICS.location(run.config)) / "metrics.parquet")
            planned.append(run)
        except NvsfError as error:
            failures[scene] = f"report: {error}"
    path = make_benchmark_report(workspace.home(), named, failures, absent, CURVES)
    metadata = report_metadata(workspace.home(), path, lacking)
    context.log_event(dg.AssetMaterialization(asset_key=key_of(REPORT), metadata=metadata, tags=inputs))
    words = closing_words(rows, states, failures, absent, path)
    words += next_view(planned[0]) if planned else []
    words += next_ui(context.run_id) if _is_of_terminal(context) else []
    sys.stdout.write("\n".join([*map(printable, words), ""]))
    sys.stdout.flush()
    return [f"{scene}: {reason}" for scene, reason in failures.items()]


def _is_of_terminal(context: dg.OpExecutionContext) -> bool:
    """Whether a terminal started this run, and not the daemon."""
    run = None if context.instance.is_ephemeral else context.instance.get_run_by_id(context.run_id)
    return run is not None and TERMINAL_TAG in run.tags


@dg.op(description="Fails the run if any scene failed, after the report of the others was made.")
def fail_if_any_failed(context: dg.OpExecutionContext, failures: list[str]) -> None:
    """Fail the run if there are recorded failures; the user's command is called by a terminal's run."""
    is_own = context.instance.is_ephemeral or _is_of_terminal(context)
    if failures and is_own and named_command():
        failure = {
            "run_id": context.run_id,
            "job": context.job_name,
            "scene": "",
            "words": "\n".join(failures),
        }
        context.log.info(call_command(failure))
        if not context.instance.is_ephemeral:
            context.instance.add_run_tags(context.run_id, {CALLED_TAG: "yes"})
    if failures:
        raise dg.Failure(
            description=f"{len(failures)} scene(s) failed: " + " | ".join(failures), allow_retries=False
        )


def make_train_all_scenes(
    stages: Sequence[Stage] = STAGES,
    *,
    without: Sequence[str] = (),
    name: str = "train_all_scenes",
    description: str = str(__doc__),
    executor: dg.ExecutorDefinition | None = None,
) -> dg.JobDefinition:
    """The job that runs a list of stages on every scene, then the report.

    Args:
        stages: The stages, each after its inputs.
        without: Names of stages to leave out.
        name: Name of the job.
        description: Description of the job, shown in the UI.
        executor: Default: the code location's.
    """
    made = zip(stages, _stage_ops(tuple(stages)), strict=True)
    ops = [op for stage, op in made if stage.name not in without]

    @dg.graph(name=name, description=description)
    def all_scenes() -> None:
        scenes, absent = choose_scenes()
        for op in ops:
            scenes = scenes.map(op)
        fail_if_any_failed(report_all(states=scenes.collect(), absent=absent))

    return all_scenes.to_job(
        resource_defs=RESOURCES | {"io_manager": PassedValues()}, logger_defs={"terse": terse_logger},
        config=TERSE_LOGGING, executor_def=executor,
    )  # fmt: skip
