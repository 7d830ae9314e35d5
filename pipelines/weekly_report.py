"""`report_follows`: a sensor that has the report made once after all runs of a regeneration."""

import dagster as dg

from assets.report import REPORT
from assets.scenes import key_of
from pipelines.jobs import RETRY_TAGS, UNFINISHED, make_report, regenerate_synthetic


@dg.sensor(
    job=make_report,
    minimum_interval_seconds=60,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Has the report made once all runs of `regenerate_synthetic` have ended, failed ones too.",
)
def report_follows(context: dg.SensorEvaluationContext) -> dg.RunRequest | dg.SkipReason:
    """Request one run of `make_report` where a regeneration ended after the report was made last."""
    instance, job = context.instance, regenerate_synthetic.name
    if instance.get_runs(dg.RunsFilter(job_name=job, statuses=UNFINISHED), limit=1):
        return dg.SkipReason(f"runs of {job} have not ended yet")
    records = instance.get_run_records(
        dg.RunsFilter(job_name=job), limit=1, order_by="update_timestamp", ascending=False
    )
    report = instance.get_latest_materialization_event(key_of(REPORT))
    made_s = 0.0 if report is None else report.timestamp
    if not records or (records[0].end_time or 0.0) <= made_s:
        return dg.SkipReason(f"no run of {job} has ended since the report was made")
    # A report that fails is not made again for the same regeneration.
    return dg.RunRequest(run_key=records[0].dagster_run.run_id, tags=RETRY_TAGS)
