"""The flow (`nvsf_core.stages.flow`): one file per stage, and how they are run.

Importing this package is cheap: a stage's file is imported when the stage runs.
"""

from nvsf_core.stages.flow import STAGE_NAMES, STAGES
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
