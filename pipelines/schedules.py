"""The schedule that makes new data sets every week."""

from collections.abc import Iterator

import dagster as dg

from assets.scenes import register
from assets.workspace import Workspace, catalogue
from nvsf_core.stages.runner.trained import newest_field
from pipelines.jobs import RETRY_TAGS, regenerate_synthetic


@dg.schedule(
    cron_schedule="0 3 * * 0",
    job=regenerate_synthetic,
    description="Sundays at 3: a new version of every trained scene's synthetic data sets.",
)
def weekly_regeneration(context: dg.ScheduleEvaluationContext) -> Iterator[dg.RunRequest | dg.SkipReason]:
    """Request one run per scene that has a field; the ISO week is the data set's seed."""
    year, week, _ = context.scheduled_execution_time.isocalendar()
    label = f"{year}-W{week:02d}"
    requested: list[str] = []
    for entry in catalogue():
        field = newest_field(Workspace().home() / entry.name)
        if field is None:
            continue
        requested.append(entry.name)
        recipe, seed = field
        register(context.instance, [entry.name])
        choice = {"recipe": recipe, "seed": seed, "draw_seed": 100 * year + week, "dataset_label": label}
        yield dg.RunRequest(
            run_key=f"{entry.name}-{label}",
            partition_key=entry.name,
            run_config={"resources": {"workspace": {"config": choice}}},
            tags={"nvsf/label": label, **RETRY_TAGS},
        )
    if not requested:
        yield dg.SkipReason("no scene has a trained field")
