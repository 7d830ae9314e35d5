"""The flow: its stages, in order, each with what it reads and what it makes; the only list of them.

Importing it is cheap, so that whoever lists the stages (Dagster at every start, commands) need not wait for
the libraries that they work with: a stage's own module is imported when the stage runs.
"""

from nvsf_core.stages.checks.declared import FIELD_CHECKS, METRIC_CHECKS, SWEEP_CHECKS, VIEW_CHECKS
from nvsf_core.stages.runner.stage import Later, Stage


def _later(module: str, function: str) -> Later:
    """A function of a module of this package."""
    return Later(f"nvsf_core.stages.{module}", function)


FRAMES = Stage(
    name="frames",
    group="ingest",
    inputs=(),
    description="Every frame of the drive: when and where it was taken, and whether it can be used.",
    version="12",
    run=_later("frames", "run"),
    reads_drive=True,
)
SWEEPS = Stage(
    name="sweeps",
    group="ingest",
    inputs=("frames",),
    description="Every LiDAR return with its laser, firing and time, as the ray that measured it.",
    version="16",
    run=_later("sweeps", "run"),
    reads_drive=True,
    check=_later("checks.sweeps", "check_sweeps"),
    check_version="8",
    named_checks=SWEEP_CHECKS,
    estimate_bytes=_later("sizes", "sweeps_bytes"),
)
PANO = Stage(
    name="pano",
    group="prepare",
    inputs=("sweeps",),
    description="Recorded scans as range images: the papers' linear 66x1030 grid and one row a laser.",
    version="1",
    run=_later("pano", "run"),
    estimate_bytes=_later("sizes", "pano_bytes"),
)
UNDISTORTED = Stage(
    name="undistorted",
    group="prepare",
    inputs=("frames",),
    description="Camera frames as pinhole images: perspective as rectified, fisheye undistorted, with masks.",
    version="4",
    run=_later("undistorted", "run"),
    estimate_bytes=_later("sizes", "undistorted_bytes"),
)
EVIDENCE = Stage(
    name="evidence",
    group="prepare",
    inputs=("frames", "sweeps"),
    description="What the training sweeps prove without learning: surfels in voxels, see-throughs, "
    "hit priors, the own vehicle, and what moves and how.",
    version="26",
    run=_later("evidence", "run"),
    estimate_bytes=_later("sizes", "proof_bytes"),
)
FIELD = Stage(
    name="field",
    group="train",
    inputs=("frames", "sweeps", "pano", "undistorted", "evidence"),
    description="The scene's trained model, for each sensor that the drive has, with the recipe and the "
    "training curve.",
    version="41",
    run=_later("field", "run"),
    estimate_bytes=_later("sizes", "field_bytes"),
    per_recipe=True,
    named_checks=FIELD_CHECKS,
)
MESH = Stage(
    name="mesh",
    group="prepare",
    inputs=("frames", "sweeps"),
    description="A Poisson mesh of the training scans (open3d): the baseline that a library gives.",
    version="2",
    run=_later("mesh", "run"),
    estimate_bytes=_later("sizes", "proof_bytes"),
)
NOVEL_VIEWS = Stage(
    name="novel_views",
    group="synthesis",
    inputs=("frames", "sweeps", "undistorted", "evidence", "mesh", "field"),
    description="Rendered LiDAR scans and images of the held-out frames, with the baselines, and of every "
    "view that was asked for; by the baselines, too, where a view's truth is known.",
    version="39",
    run=_later("novel_views", "run"),
    per_recipe=True,
    reads_views=True,
    estimate_bytes=_later("sizes", "novel_views_bytes"),
    check=_later("novel_views", "check"),
    check_version="5",
    named_checks=VIEW_CHECKS,
)
SCENE_METRICS = Stage(
    name="scene_metrics",
    group="measure",
    inputs=("frames", "sweeps", "undistorted", "novel_views"),
    description=(
        "Errors and times of the held-out frames under each protocol, whole and around moving objects, for "
        "the trained field and for the baselines that learn nothing; the same of views whose truth is known; "
        "and of every view what can be said without its truth."
    ),
    version="18",
    run=_later("scene_metrics", "run"),
    per_recipe=True,
    reads_truth=True,
    check=_later("checks.metrics", "check_metrics"),
    check_version="5",
    named_checks=METRIC_CHECKS,
)
DATASET = Stage(
    name="dataset",
    group="export",
    inputs=("frames", "evidence", "novel_views", "scene_metrics"),
    description="Versioned synthetic data sets: ray drop and range noise drawn, scans and pictures exported,"
    " with a manifest of what they came from and a card of how wrong they are.",
    version="16",
    run=_later("dataset", "run"),
    per_recipe=True,
    per_draw=True,
    reads_views=True,
    estimate_bytes=_later("sizes", "dataset_bytes"),
    tidy=_later("kept_versions", "tidy_versions"),
)

STAGES = (FRAMES, SWEEPS, PANO, UNDISTORTED, EVIDENCE, FIELD, MESH, NOVEL_VIEWS, SCENE_METRICS, DATASET)
STAGE_NAMES = tuple(stage.name for stage in STAGES)
WORK_MODULES = tuple(f"nvsf_core.stages.{name}" for name in STAGE_NAMES)
"""Modules of the stages' work: a process that forks others, which run stages, imports them once for all."""
