"""Report: one page over all scenes."""

from collections.abc import Sequence
from pathlib import Path

import dagster as dg

from assets.automation import CATALOGUE_TAGS, follows_all_scenes
from assets.factory import FRESH
from assets.provenance import made_of
from assets.scenes import OWNERS, key_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.drive import has_data
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.errors import CatalogueError, NvsfError
from nvsf_core.stages.runner.patience import patiently

METRICS_STAGE, DATASET_STAGE, REPORT = "scene_metrics", "dataset", "benchmark_report"
CURVES = Path(__file__).resolve().parents[1] / "benchmarks" / "results" / "curves"
"""Folder where `make bench` stores error over training time; the report shows it."""


@dg.asset(
    key=key_of(REPORT),
    deps=[key_of(METRICS_STAGE), key_of(DATASET_STAGE)],
    group_name="report",
    owners=OWNERS,
    automation_condition=follows_all_scenes(),
    freshness_policy=FRESH,
    kinds={"html"},
    description="One offline HTML page over all scenes: tables, range images, camera pairs, loss curves, "
    "speed beside error.",
)
def benchmark_report(context: dg.AssetExecutionContext, workspace: Workspace) -> dg.MaterializeResult:
    """Make the page from all scenes that have metrics, of any recipe and seed."""
    home = workspace.home()
    try:
        absent = patiently(lambda: scenes_without_data(home), context.log.info)
    except CatalogueError as error:
        context.instance.add_run_tags(context.run.run_id, CATALOGUE_TAGS)
        raise dg.Failure(description=str(error), allow_retries=False) from error
    page = write_benchmark_report(home, absent)
    return dg.MaterializeResult(metadata=report_metadata(home, page, absent))


def report_metadata(home: Path, page: Path, absent: Sequence[str]) -> dict[str, dg.MetadataValue]:
    """Metadata of a report: its page, how many scenes have metrics, and how many have no data (`absent`)."""
    from nvsf_core.reporting.scene_outputs import measured_scenes  # see `write_benchmark_report`

    return {
        "path": dg.MetadataValue.path(str(page)),
        "scenes": dg.MetadataValue.int(len(measured_scenes(home))),
        "scenes_without_data": dg.MetadataValue.int(len(absent)),
    }


def report_made_of(instance: dg.DagsterInstance, run_id: str) -> dict[str, str]:
    """Tags of the event of a report that no run of assets makes; to be asked for before it is made."""
    inputs = [key_of(METRICS_STAGE), key_of(DATASET_STAGE)]
    return made_of(instance, run_id, inputs)  # a run's id, as Dagster has it where there is no code version


def write_benchmark_report(home: Path, absent: Sequence[str]) -> Path:
    """Make the page from all metrics under `home`, without Dagster; returns its path.

    Args:
        home: Folder of all outputs.
        absent: Scenes without data, which the page names.
    """
    # Here, because it loads matplotlib and zarr, for which no start of Dagster should wait.
    from nvsf_core.stages.benchmark_report import make_benchmark_report

    return make_benchmark_report(home, [], {}, absent, CURVES)


def scenes_without_data(home: Path) -> list[str]:
    """Scenes of the catalogue that were not measured and whose recordings are not here.

    Raises:
        CatalogueError: The catalogue cannot be read.
    """
    from nvsf_core.reporting.scene_outputs import measured_scenes  # see `write_benchmark_report`

    measured = measured_scenes(home)
    return [entry.name for entry in catalogue() if entry.name not in measured and not _is_there(entry)]


def _is_there(entry: SceneEntry) -> bool:
    try:
        return has_data(entry)
    except NvsfError:
        return False  # what hinders is said by its own run


report_assets = [benchmark_report]
