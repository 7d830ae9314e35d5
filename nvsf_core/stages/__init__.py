"""The flow: one file per stage, and the only list of the stages, in order.

Importing this package is cheap; the stages are imported when `STAGES` is first read.
"""

from importlib import import_module
from typing import Any

from nvsf_core.stages.runner.run import SceneRun, find_scene, plan_run, run_named_stage, run_scene
from nvsf_core.stages.runner.stage import Check, Outcome, RunConfig, Stage

__all__ = [
    "STAGES",
    "STAGE_NAMES",
    "Check",
    "Outcome",
    "RunConfig",
    "SceneRun",
    "Stage",
    "find_scene",
    "plan_run",
    "run_named_stage",
    "run_scene",
]

STAGE_NAMES = (
    "frames",
    "sweeps",
    "pano",
    "undistorted",
    "evidence",
    "field",
    "mesh",
    "novel_views",
    "scene_metrics",
    "dataset",
)

STAGES: tuple[Stage, ...]


def __getattr__(name: str) -> Any:
    if name != "STAGES":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    stages = tuple(import_module(f"{__name__}.{stage}").STAGE for stage in STAGE_NAMES)
    globals()["STAGES"] = stages
    return stages
