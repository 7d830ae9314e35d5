"""`catalogue_again`: a sensor that launches again what failed because the catalogue could not be read."""

from collections.abc import Iterator

import dagster as dg

from assets.automation import CATALOGUE_TAGS, KEPT
from assets.report import REPORT
from assets.scenes import PARTITION_TAG, SCENES, key_of
from assets.workspace import catalogue
from nvsf_core.errors import CatalogueError
from pipelines.jobs import RETRY_TAGS, make_report, regenerate_synthetic, train_scene

LAUNCHED_TAG = "nvsf/launched_again"
"""Tag of a run that the sensor launched: how often in a row."""
_MOST_TIMES = 5
"""Where the sensor reads a catalogue that its runs cannot read, as in another container, nothing helps."""
_KEPT_TAGS = (KEPT, "nvsf/label", *RETRY_TAGS)
_JOBS = {job.name: job for job in (train_scene, regenerate_synthetic, make_report)}


@dg.sensor(
    jobs=list(_JOBS.values()),
    minimum_interval_seconds=30,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Launches again what a sensor or the schedule launched and what failed because the catalogue "
    "could not be read, once it can be.",
)
def catalogue_again(context: dg.SensorEvaluationContext) -> Iterator[dg.RunRequest | dg.SkipReason]:
    """Request one run for each scene whose newest run failed for the catalogue; the report's, too."""
    runs = list(_failed_for_the_catalogue(context.instance))
    if not runs:
        yield dg.SkipReason("no run that a sensor or the schedule launched has failed for the catalogue")
        return
    try:
        names = {entry.name for entry in catalogue()} & set(
            context.instance.get_dynamic_partitions(SCENES.name or "")
        )
    except CatalogueError as error:
        yield dg.SkipReason(f"{len(runs)} runs wait: {error}")
        return
    for run in runs:
        scene = run.tags.get(PARTITION_TAG)
        if scene is not None and scene not in names:
            continue
        job = run.job_name if run.job_name in _JOBS else (make_report if scene is None else train_scene).name
        yield dg.RunRequest(
            run_key=run.run_id,  # of which the daemon launches one
            job_name=job,
            partition_key=scene,
            run_config=run.run_config,
            asset_selection=sorted(run.asset_selection) if run.asset_selection else None,
            tags={tag: run.tags[tag] for tag in _KEPT_TAGS if tag in run.tags}
            | {LAUNCHED_TAG: str(_times(run) + 1)},
        )


def _failed_for_the_catalogue(instance: dg.DagsterInstance) -> Iterator[dg.DagsterRun]:
    """Runs that nothing has followed since, and that no person launched, who would see it."""
    failed = dg.RunsFilter(statuses=[dg.DagsterRunStatus.FAILURE], tags=CATALOGUE_TAGS | RETRY_TAGS)
    looked_at: set[str | None] = set()
    for record in instance.get_run_records(failed, limit=100):  # the newest first
        run = record.dagster_run
        scene = run.tags.get(PARTITION_TAG)
        if scene in looked_at:
            continue
        looked_at.add(scene)
        if scene is None:
            report = instance.get_latest_materialization_event(key_of(REPORT))
            is_newest = report is None or report.timestamp < (record.end_time or 0.0)
        else:
            (newest,) = instance.get_runs(dg.RunsFilter(tags={PARTITION_TAG: scene}), limit=1)
            is_newest = newest.run_id == run.run_id
        if is_newest and _times(run) < _MOST_TIMES:
            yield run


def _times(run: dg.DagsterRun) -> int:
    return int(run.tags.get(LAUNCHED_TAG, "0"))
