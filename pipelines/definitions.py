"""The project's Dagster code location: assets, jobs, schedules and sensors."""

import dagster as dg

from assets.drives import drive_assets
from assets.export import export_assets
from assets.ingest import ingest_assets
from assets.measure import measure_assets
from assets.offers import offer_checks
from assets.prepare import prepare_assets
from assets.report import report_assets
from assets.synthesis import synthesis_assets
from assets.train import train_assets
from pipelines.catalogue_runs import catalogue_again
from pipelines.executors import executor_from_environment
from pipelines.failures import failure_command
from pipelines.jobs import JOBS
from pipelines.reaper import stale_run_reaper
from pipelines.resources import RESOURCES
from pipelines.schedules import weekly_regeneration
from pipelines.sensors import new_drives, scenes_follow
from pipelines.terminal import terse_logger
from pipelines.weekly_report import report_follows

defs = dg.Definitions(
    assets=[
        *drive_assets,
        *ingest_assets,
        *prepare_assets,
        *train_assets,
        *synthesis_assets,
        *measure_assets,
        *export_assets,
        *report_assets,
    ],
    asset_checks=offer_checks,
    jobs=JOBS,
    schedules=[weekly_regeneration],
    sensors=[
        new_drives,
        scenes_follow,
        report_follows,
        catalogue_again,
        stale_run_reaper,
        failure_command,
    ],
    resources=RESOURCES,
    executor=executor_from_environment(),
    loggers={"terse": terse_logger},
)
