"""The flow: one file a stage, and here, in order, the only list of them.

Importing this package is cheap; the stages themselves are imported when `STAGES` is first asked for.
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
