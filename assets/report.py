"""Report: the metrics of each scene, and one page over all of them."""

import dagster as dg

from assets.factory import assets_of_group
from assets.workspace import Workspace, catalogue
from nvsf_core.kitti360.catalogue import has_data
from nvsf_core.stages import STAGES
from nvsf_core.stages.benchmark_report import make_benchmark_report

METRICS_STAGE = "scene_metrics"


@dg.asset(
    deps=[METRICS_STAGE],
    group_name="report",
    kinds={"html"},
    description="One offline HTML page over all scenes: tables, range images, camera pairs, loss curves, "
    "speed beside error.",
)
def benchmark_report(workspace: Workspace) -> dg.MaterializeResult:
    """Make the page from whatever scenes have metrics for the recipe and seed of this run."""
    measured = [entry.name for entry in catalogue() if has_metrics(workspace, entry.name)]
    no_data = [entry.name for entry in catalogue() if entry.name not in measured and not has_data(entry)]
    path = make_benchmark_report(workspace.home(), measured, {}, no_data)
    return dg.MaterializeResult(
        metadata={
            "path": dg.MetadataValue.path(str(path)),
            "scenes": dg.MetadataValue.int(len(measured)),
            "scenes_without_data": dg.MetadataValue.int(len(no_data)),
        }
    )


def has_metrics(workspace: Workspace, scene: str) -> bool:
    """Whether the scene was measured with the recipe and seed of this run."""
    run = workspace.plan(scene)
    stage = next(stage for stage in STAGES if stage.name == METRICS_STAGE)
    return run.store.path(stage.location(run.config)).is_dir()


report_assets = [*assets_of_group("report"), benchmark_report]
