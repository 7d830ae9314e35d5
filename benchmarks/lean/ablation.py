"""Whether heuristic sampling, L_grad, another range loss or larger tables help the LiDAR's residual field.

Run ``python -m benchmarks.lean.ablation [--scenes k360_street] [--steps 600] [--seeds 2]``. Every variant is
judged on every 7th training frame, left out (the split `val` of `benchmarks.speed_error.plan`); held-out
frames are neither trained nor looked at. A finished run stands in benchmarks/results/lean_ablation.json and
is never repeated; ``--table`` only writes docs/lean_ablation.md from it.
"""

import argparse
import json
import os
import time
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import torch

from benchmarks.common import places
from benchmarks.common.commit import commit
from benchmarks.lean.rigidity import RESULTS as RIGIDITY
from benchmarks.lean.rigidity import section
from benchmarks.lean.variants import VARIANTS, RayGrid, Variant, VariantStep, ray_grid
from benchmarks.speed_error.plan import VAL, Split, split_of
from benchmarks.speed_error.scoring import LIDAR_METRICS, RAW_METRICS, Judge, judge_of
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.errors import DataError
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.metrics.table import BASELINES
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.models.residual.capacity import needed_field
from nvsf_core.models.residual.training_rays import LidarRays, training_rays
from nvsf_core.recipe import ResidualRecipe, preset
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.host import machine
from nvsf_core.stages.runner.run import SceneRun, find_scene, run_named_stage, say_on_stderr
from nvsf_core.stages.runner.stage import RunConfig
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.training.loop import TrainingState, make_optimiser, train

RESULTS = places.RESULTS / "lean_ablation.json"
DOCUMENT = places.DOCS / "lean_ablation.md"
STAGES_BEFORE = ("frames", "undistorted", "sweeps", "evidence", "mesh")
EVIDENCE_ONLY = "evidence alone, nothing learned"
_SHOWN = dict(zip(
    (*LIDAR_METRICS, *RAW_METRICS, "cpu_seconds"),
    ("CD m²", "F", "PSNR dB", "hit accuracy", "raw median m", "raw p90 m", "CPU s"), strict=True,
))  # fmt: skip
_LOWER_IS_BETTER = ("chamfer_m2", *RAW_METRICS)
_DIGITS = dict(zip(_SHOWN, (4, 4, 2, 4, 4, 3, 0), strict=True))

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What all runs of a scene share."""

    split: Split
    store: SceneStore
    """Outputs of the split's stages."""
    lidar: LidarRecording
    judge: Judge
    rays: LidarRays
    grid: RayGrid
    commit: str
    """Of the code as it was loaded."""


def main() -> None:
    """Do the runs that are not done yet, then write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["k360_street"])
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--variants", nargs="*", default=[variant.name for variant in VARIANTS])
    parser.add_argument("--table", action="store_true", help="only write docs/lean_ablation.md")
    arguments = parser.parse_args()
    recipe = preset("quick")
    # But for the number of steps, what `lean` trains its LiDAR with.
    assert isinstance(recipe, ResidualRecipe)
    # One thread: seconds of CPU then mean the same on a busy machine.
    training = replace(recipe.lidar_training, steps=arguments.steps, threads=1)
    recipe = replace(recipe, lidar_training=training)
    chosen = [variant for variant in VARIANTS if variant.name in arguments.variants]
    for name in () if arguments.table else arguments.scenes:
        run_scene(name, recipe, chosen, arguments.seeds)
    DOCUMENT.write_text(document(read_rows()))


def run_scene(name: str, recipe: ResidualRecipe, variants: list[Variant], seeds: int) -> None:
    """All runs of a scene that do not stand in the results; seeds outermost."""
    steps = recipe.lidar_training.steps
    done = {(r["variant"], r["seed"]) for r in read_rows() if (r["scene"], r["steps"]) == (name, steps)}
    left = [(v, seed) for seed in range(seeds) for v in variants if (v.name, seed) not in done]
    unlearned = [one for one in (EVIDENCE_ONLY, *BASELINES) if (one, 0) not in done]
    if not left and not unlearned:
        return
    scene = prepared(name, recipe)
    for one in unlearned:
        errors = unlearned_errors(scene, one)
        write_rows([*read_rows(), _row(scene, one, 0, steps, errors | {"cpu_seconds": 0.0})])
    for variant, seed in left:
        row = _row(scene, variant.name, seed, steps, run(scene, recipe, variant, seed))
        write_rows([*read_rows(), row])
        say_on_stderr(f"[{name}] {json.dumps(row)}")


def unlearned_errors(scene: Scene, name: str) -> dict[str, float]:
    """Errors of a baseline, or of the evidence alone, which is `reproject` as the variants start from it.

    Raises:
        DataError: The stage `mesh` made none here.
    """
    recording = scene.judge.recording
    if name == "copy_nearest":
        return scene.judge.copy_errors()
    if name != "mesh":
        return scene.judge.errors(reprojection(recording), thin_images=False)
    # Loads open3d, whose memory is not another run's.
    from nvsf_core.models.baselines.mesh import mesh_baseline
    from nvsf_core.stages.mesh import read_mesh

    model = mesh_baseline(read_mesh(scene.store), recording)
    if model is None:
        place = scene.store.path("mesh")
        raise DataError(f"{place}: expected a mesh, found none; its stage.json says why")
    return scene.judge.errors(model, thin_images=False)


def prepared(name: str, recipe: ResidualRecipe) -> Scene:
    """The scene's LiDAR with the left-out frames held out too, and its training rays."""
    started_at = commit()
    home, split = home_from_environment(os.environ), split_of(find_scene(name), VAL)
    store = split.store(home)
    plan = SceneRun(scene=split.entry, store=store, config=RunConfig(recipe=preset("quick")))
    for stage in STAGES_BEFORE:
        run_named_stage(stage, plan, say_on_stderr)
    recording = replace(read_recording(store), cameras={})
    lidar = recording.lidar
    if lidar is None:
        raise SystemExit(f"scene {name}: expected a LiDAR, found none")
    # Where objects lie in a field depends on its bounds alone, which are the same in every variant.
    rays = training_rays(lidar, recipe, make_field(lidar, recipe, VARIANTS[0], 0))
    return Scene(
        split=split, store=store, lidar=lidar, judge=judge_of(recording, store, split.scored), rays=rays,
        grid=ray_grid(lidar, rays), commit=started_at,
    )  # fmt: skip


def run(scene: Scene, recipe: ResidualRecipe, variant: Variant, seed: int) -> dict[str, float]:
    """Train one variant and score it."""
    lidar = scene.lidar
    field = make_field(lidar, recipe, variant, seed)
    static = lidar.evidence.for_rendering if variant.shaped else lidar.evidence.static
    step = VariantStep(variant, field, static, scene.rays, recipe, lidar.far_m, scene.grid)
    generator = torch.Generator().manual_seed(2 * seed)
    state = TrainingState(field, make_optimiser(field, recipe.lidar_training), generator)
    started = time.process_time()
    train(state, recipe.lidar_training, step, lambda *_: None, say_on_stderr)
    spent = time.process_time() - started
    model = SceneModel(
        lidar=field_renderer(
            field, static, lidar.moving(),
            most=recipe.evidence.lidar_candidates, far_m=lidar.far_m,
        ),
        camera=None, prior_scans=recipe.evidence.votes,
    )  # fmt: skip
    parameters = sum(p.numel() for p in field.parameters())
    errors = scene.judge.errors(model, thin_images=False)
    return errors | {"cpu_seconds": spent, "wall_seconds": state.seconds, "parameters": parameters}


def make_field(lidar: LidarRecording, recipe: ResidualRecipe, variant: Variant, seed: int) -> LidarField:
    """The field that the recipe gives the scene, with the variant's tables."""
    surfels = lidar.evidence.surfels
    low, high = surfels.mean_m.min(axis=0), surfels.mean_m.max(axis=0)
    bounds = Bounds.around(tuple(low.tolist()), tuple(high.tolist()))
    spec = needed_field(recipe.lidar_field, surfels)
    spec = replace(spec, log2_table=variant.log2_table or spec.log2_table)
    return LidarField(spec, bounds, torch.Generator().manual_seed(seed))


def _row(scene: Scene, variant: str, seed: int, steps: int, values: dict[str, float]) -> Row:
    return {
        "scene": scene.split.entry.name, "variant": variant, "seed": seed, "steps": steps,
        "scored": list(scene.split.scored), "machine": machine(), "commit": scene.commit, **values,
    }  # fmt: skip


def read_rows() -> list[Row]:
    """All rows so far."""
    rows: list[Row] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else []
    return rows


def write_rows(rows: list[Row]) -> None:
    """Replace the file as a whole: a killed run leaves the old one."""
    lines = ",\n".join(json.dumps(row) for row in rows)
    partial = RESULTS.with_suffix(".partial")
    partial.write_text(f"[\n{lines}\n]\n")
    partial.replace(RESULTS)


def document(rows: list[Row]) -> str:
    """docs/lean_ablation.md: one table a scene, means over the seeds and how far the seeds lie apart."""
    parts = [
        "# What `lean`'s LiDAR does without: measured",
        "",
        "Generated by `python -m benchmarks.lean.ablation --table` from `benchmarks/results/`; do not edit.",
        "The ray field of `quick` and `lean` alone, without `lean`'s networks of hits and pano; one thing",
        "changed a row, all else equal; left-out training frames (split `val`), protocols `lidar4d_scan`",
        "and `raw` on a quarter of the rays. Mean over the seeds ± half of their range. **Bold**: better",
        "than `as it is` on every seed, and by more than the wider of the two ranges. CPU s: training, on",
        "one thread of a busy machine.",
        "`evidence alone` is `reproject` at its row's commit (before decision 0013 without shapes); the",
        "baselines' commits are the last ones named.",
        "Not measured on KITTI-360's ten scenes.",
        "",
    ]
    for scene, steps in dict.fromkeys((row["scene"], row["steps"]) for row in rows):
        parts += _table([row for row in rows if (row["scene"], row["steps"]) == (scene, steps)])
    return "\n".join([*parts, *(section(json.loads(RIGIDITY.read_text())) if RIGIDITY.is_file() else ())])


def _table(rows: list[Row]) -> list[str]:
    first = rows[0]
    seeds = sorted({row["seed"] for row in rows})
    lines = [
        f"## {first['scene']}, {first['steps']} steps of 4096 rays",
        "",
        f"Scored frames {', '.join(map(str, first['scored']))}; seeds {', '.join(map(str, seeds))}; "
        f"{first['machine']}; commit {', '.join(dict.fromkeys(row['commit'] for row in rows))}.",
        "",
        "| variant | seeds | " + " | ".join(_SHOWN.values()) + " |",
        "|---|---:|" + "---:|" * len(_SHOWN),
    ]
    base = [row for row in rows if row["variant"] == VARIANTS[0].name]
    for name in dict.fromkeys(row["variant"] for row in rows):
        mine = [row for row in rows if row["variant"] == name]
        cells = [_cell(mine, base, metric) for metric in _SHOWN]
        lines.append(f"| {name} | {len(mine)} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _cell(mine: list[Row], base: list[Row], metric: str) -> str:
    values = [row[metric] for row in mine]
    text = f"{fmean(values):.{_DIGITS[metric]}f}"
    if len(values) > 1:
        text += f" ± {0.5 * (max(values) - min(values)):.{_DIGITS[metric]}f}"
    return f"**{text}**" if helps(mine, base, metric) else text


def helps(mine: list[Row], base: list[Row], metric: str) -> bool:
    """Whether a variant is better on every seed that both have, by more than either's seeds lie apart."""
    if metric == "cpu_seconds" or len(mine) < 2 or len(base) < 2:
        return False
    sign = -1.0 if metric in _LOWER_IS_BETTER else 1.0
    old = {row["seed"]: sign * row[metric] for row in base}
    new = {row["seed"]: sign * row[metric] for row in mine}
    apart = max(max(side.values()) - min(side.values()) for side in (old, new))
    both = old.keys() & new.keys()
    return all(new[seed] > old[seed] for seed in both) and fmean(new.values()) - fmean(old.values()) > apart


if __name__ == "__main__":
    main()
