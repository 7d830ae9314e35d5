"""The Dagster jobs; `train_all_scenes` is built in `pipelines.train_all`."""

import dagster as dg

from assets.automation import KEPT_TAGS, SAMPLES_TAGS
from assets.offers import offer_checks
from assets.report import REPORT
from assets.scenes import key_of
from pipelines.executors import timing_executor
from pipelines.terminal import TERSE_LOGGING
from pipelines.train_all import make_train_all_scenes

RETRY_TAGS = {"dagster/max_retries": "2"}
"""Of what the daemon launches: a run whose process died is launched again; one whose step failed is not."""
_FINISHED = (dg.DagsterRunStatus.SUCCESS, dg.DagsterRunStatus.FAILURE, dg.DagsterRunStatus.CANCELED)
UNFINISHED = [status for status in dg.DagsterRunStatus if status not in _FINISHED]
"""Of a run that waits or is at work."""

train_all_scenes = make_train_all_scenes()

# Each run has one recipe and one seed; `make bench` (benchmarks/run.py) runs it for each of SEEDS.
benchmark = make_train_all_scenes(
    without=["dataset"],
    name="benchmark",
    description="Every scene from its recorded drive to its metrics, one step at a time so that seconds are "
    "comparable; no data sets are made.",
    executor=timing_executor(),
)

_up_to_dataset = dg.AssetSelection.assets(key_of("dataset")).upstream().materializable()
# Checks over all scenes belong to no scene's run: `new_drives` makes them.
for _check in offer_checks:
    _up_to_dataset -= dg.AssetSelection.checks(_check)

train_scene = dg.define_asset_job(
    "train_scene",
    selection=_up_to_dataset,
    config=TERSE_LOGGING,
    description="One scene, from its recorded drive to its data set; what is up to date is skipped.",
)

regenerate_synthetic = dg.define_asset_job(
    "regenerate_synthetic",
    selection=_up_to_dataset,
    config=TERSE_LOGGING,
    tags=KEPT_TAGS | SAMPLES_TAGS,
    description="A new version of a scene's synthetic data sets, sampled with the run's own seed, by the "
    "scene's newest field; it is trained again only where its drive or the code changed.",
)

make_report = dg.define_asset_job(
    "make_report",
    selection=dg.AssetSelection.assets(key_of(REPORT)),
    config=TERSE_LOGGING,
    description="The report over all scenes; it has no partition, so the jobs of one scene do not make it.",
)

JOBS = [train_all_scenes, train_scene, regenerate_synthetic, make_report, benchmark]
