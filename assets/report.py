"""Report: one page over all scenes."""

from pathlib import Path
from typing import NamedTuple

import dagster as dg

from assets.automation import follows_all_scenes
from assets.factory import FRESH
from assets.provenance import made_of
from assets.scenes import OWNERS, key_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.drive import has_data
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.errors import NvsfError

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
def benchmark_report(workspace: Workspace) -> dg.MaterializeResult:
    """Make the page from all scenes that have metrics, of any recipe and seed."""
    home = workspace.home()
    written = write_benchmark_report(home)
    return dg.MaterializeResult(
        metadata={
            "path": dg.MetadataValue.path(str(written.path)),
            "scenes": dg.MetadataValue.int(written.scenes),
            "scenes_without_data": dg.MetadataValue.int(written.scenes_without_data),
        }
    )


def report_made_of(instance: dg.DagsterInstance, run_id: str) -> dict[str, str]:
    """Tags of the event of a report that no run of assets makes; to be asked for before it is made."""
    inputs = [key_of(METRICS_STAGE), key_of(DATASET_STAGE)]
    return made_of(instance, run_id, inputs)  # a run's id, as Dagster has it where there is no code version


class WrittenReport(NamedTuple):
    """Path of the page, and how many scenes it shows."""

    path: Path
    scenes: int
    scenes_without_data: int


def write_benchmark_report(home: Path) -> WrittenReport:
    """Make the page from all metrics under `home`, without Dagster."""
    # Here, because they load matplotlib and zarr, for which no start of Dagster should wait.
    from nvsf_core.reporting.scene_outputs import measured_scenes
    from nvsf_core.stages.benchmark_report import make_benchmark_report

    measured = measured_scenes(home)
    no_data = [entry.name for entry in catalogue() if entry.name not in measured and not _is_there(entry)]
    path = make_benchmark_report(home, [], {}, no_data, CURVES)
    return WrittenReport(path, len(measured), len(no_data))


def _is_there(entry: SceneEntry) -> bool:
    try:
        return has_data(entry)
    except NvsfError:
        return False  # what hinders is said by its own run


report_assets = [benchmark_report]
