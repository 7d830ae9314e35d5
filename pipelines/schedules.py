"""The schedule that makes new data sets every week."""

from collections.abc import Iterator
from pathlib import Path

import dagster as dg

from assets.workspace import Workspace, catalogue
from nvsf_core.errors import RecipeError
from nvsf_core.recipe import is_seed_folder, preset
from nvsf_core.stages.runner.record import RECORD_NAME, read_record
from nvsf_core.stores.scene_store import published
from pipelines.jobs import regenerate_synthetic


@dg.schedule(
    cron_schedule="0 3 * * 0",
    job=regenerate_synthetic,
    description="Sundays at 3: a new version of every trained scene's synthetic data sets.",
)
def weekly_regeneration(context: dg.ScheduleEvaluationContext) -> Iterator[dg.RunRequest | dg.SkipReason]:
    """Request one run per scene that has a field; the ISO week is the data set's seed."""
    year, week, _ = context.scheduled_execution_time.isocalendar()
    label = f"{year}-W{week:02d}"
    requested = 0
    for entry in catalogue():
        field = newest_field(Workspace().home() / entry.name)
        if field is None:
            continue
        requested += 1
        recipe, seed = field
        choice = {"recipe": recipe, "seed": seed, "draw_seed": 100 * year + week, "dataset_label": label}
        yield dg.RunRequest(
            run_key=f"{entry.name}-{label}",
            partition_key=entry.name,
            run_config={"resources": {"workspace": {"config": choice}}},
            tags={"nvsf/label": label},
        )
    if not requested:
        yield dg.SkipReason("no scene has a trained field")


def _is_known(folder: Path) -> bool:
    """Whether a field's folder is named by a seed, below a preset's name."""
    try:
        preset(folder.parent.name)
    except RecipeError:
        return False
    return is_seed_folder(folder.name)


def newest_field(scene_root: Path) -> tuple[str, int] | None:
    """Recipe and seed of the scene's latest published field; None if there is no readable one."""
    fields = [path.parent for path in published(scene_root, f"field/*/*/{RECORD_NAME}")]
    sound = [folder for folder in fields if _is_known(folder) and read_record(folder) is not None]
    if not sound:
        return None
    newest = max(sound, key=lambda folder: ((folder / RECORD_NAME).stat().st_mtime, str(folder)))
    return newest.parent.name, int(newest.name)
