"""A flow of two stages, of which one kills its process on the scene `bad`; run as a script by a test."""

import os
import signal
import sys

import dagster as dg

from nvsf_core.metrics.table import COLUMNS
from nvsf_core.stages.runner.stage import Stage, StageOutput
from nvsf_core.stores.tables import write_rows
from pipelines.step_processes import step_processes
from pipelines.train_all import make_train_all_scenes


def _ingest(task):
    if task.scene.name == "bad":
        os.kill(os.getpid(), signal.SIGSEGV)
    (task.folder / "rows").write_text("1")
    return StageOutput()


def _measure(task):
    write_rows(task.folder / "metrics.parquet", [], COLUMNS)
    return StageOutput()


FLOW = (
    Stage(name="frames", group="ingest", inputs=(), description="rows", version="1", run=_ingest),
    Stage(
        name="scene_metrics", group="report", inputs=("frames",), description="no metrics", version="1",
        run=_measure, per_recipe=True,
    ),
)  # fmt: skip


def crashing_job():
    """The job, in processes of their own as the user's is."""
    return make_train_all_scenes(FLOW, executor=step_processes(3))


if __name__ == "__main__":
    done = dg.execute_job(
        dg.reconstructable(crashing_job), instance=dg.DagsterInstance.get(), raise_on_error=False
    )
    sys.exit(0 if done.success else 1)
