"""NaN in weights and gradients, and trainings that diverge: named, stopped, and gone on from more slowly."""

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import DivergedError
from nvsf_core.models.paper import family as paper_training
from nvsf_core.models.residual import lidar as residual_training
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.presets import preset, slower
from nvsf_core.recipe.residual import FieldSpec, TrainingSpec
from nvsf_core.stages import Outcome, plan_run, run_named_stage
from nvsf_core.stores.checkpoints import load_tensors

STEPS, BREAKS_AT = 20, 8
RESIDUAL = replace(
    preset("smoke"),
    lidar_field=FieldSpec(levels=2, log2_table=8),
    lidar_training=TrainingSpec(steps=STEPS, rays=64, parts=1, checkpoint_s=0.0),
)
PAPER = preset("paper_smoke")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny drive without cameras, and its stages up to the field."""
    folder = tmp_path_factory.mktemp("diverging")
    write_demo(folder / "drive", size=DemoSize.tiny())
    shutil.rmtree(folder / "drive" / "data_2d_raw")
    (folder / "drive" / "calibration" / "perspective.txt").unlink()
    for stage in ("frames", "sweeps", "pano", "undistorted", "evidence"):
        _run(folder / "drive", folder / "home", stage, RESIDUAL)
    return folder


@pytest.fixture
def home(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared / "home", tmp_path / "home")
    return tmp_path / "home"


def _run(root: Path, home: Path, stage: str, recipe: Recipe, said: list[str] | None = None) -> Outcome:
    scene = SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,)
    )
    return run_named_stage(
        stage, plan_run(scene, home, recipe=recipe), [].append if said is None else said.append
    )


def _into_weights(model: nn.Module) -> None:
    with torch.no_grad():
        next(model.parameters()).fill_(math.nan)


def _into_gradients(model: nn.Module) -> None:
    for parameter in model.parameters():
        parameter.register_hook(lambda gradient: gradient * math.nan)


def _break(patch: pytest.MonkeyPatch, module: object, name: str, how: Callable[[nn.Module], None]) -> None:
    """Before its step number `BREAKS_AT`, do something to the model that a step function trains."""
    step, seen = getattr(module, name), []

    def broken(model: nn.Module, *rest: object) -> object:
        seen.append(1)
        if len(seen) == BREAKS_AT + 1:
            how(model)
        return step(model, *rest)

    patch.setattr(module, name, broken)


@pytest.mark.parametrize(
    ("recipe", "module", "step"),
    [(RESIDUAL, residual_training, "lidar_step"), (PAPER, paper_training, "paper_step")],
    ids=["residual", "paper"],
)
@pytest.mark.parametrize(
    ("how", "tensor"),
    [
        (_into_weights, "weights '[a-z_.0-9]+' are not finite"),
        (_into_gradients, "its gradient by weights '[a-z_.0-9]+'"),
    ],
    ids=["weights", "gradients"],
)
def test_a_nan_names_scene_step_term_and_tensor(
    prepared: Path, home: Path, monkeypatch: pytest.MonkeyPatch, recipe: Recipe, module: object, step: str,
    how: Callable[[nn.Module], None], tensor: str,
) -> None:  # fmt: skip
    _break(monkeypatch, module, step, how)
    wanted = rf"scene tiny, recipe {recipe.name}, [a-z]+: step {BREAKS_AT}: loss term '[a-z_]+'.*{tensor}"
    with pytest.raises(DivergedError, match=wanted):
        _run(prepared / "drive", home, "field", recipe)
    assert not (home / "tiny" / "field" / recipe.name / "0").exists()


def test_a_training_that_diverged_goes_on_from_its_last_good_checkpoint_with_smaller_steps(
    prepared: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, work = prepared / "drive", home / "tiny" / ".work" / "field"

    def explode(model: nn.Module) -> None:
        with torch.no_grad():
            for parameter in model.parameters():
                parameter *= 1e30

    with monkeypatch.context() as patch:
        _break(patch, residual_training, "lidar_step", explode)
        with pytest.raises(
            DivergedError, match=rf"of step {BREAKS_AT - 1} is kept: the recipe smoke@0.5 goes on"
        ):
            _run(root, home, "field", RESIDUAL)
    kept, facts = load_tensors(work / "smoke" / "0" / "lidar.safetensors")
    assert facts["step"] == BREAKS_AT - 1
    assert all(bool(torch.isfinite(value).all()) for value in kept.values())

    half = slower(RESIDUAL, 0.5)
    assert half.lidar_training.table_rate == 0.5 * RESIDUAL.lidar_training.table_rate
    said: list[str] = []
    outcome = _run(root, home, "field", half, said)
    assert any(f"lidar: resumed from the checkpoint at step {BREAKS_AT - 1}" in line for line in said)
    doubts = [check.detail for check in outcome.checks if check.name == "training_never_diverged"]
    assert len(doubts) == 1 and f"step {BREAKS_AT}" in doubts[0]
    weights, _ = load_tensors(outcome.path / "weights.safetensors")
    assert all(bool(torch.isfinite(value).all()) for value in weights.values())


def test_steps_that_are_far_too_large_are_an_error_and_never_weights(prepared: Path, home: Path) -> None:
    spec = replace(RESIDUAL.lidar_training, network_rate=1e20, table_rate=1e20)
    recipe = replace(RESIDUAL, name="wild", lidar_training=spec)
    with pytest.raises(
        DivergedError, match=r"scene tiny, recipe wild, lidar: step \d+: .*lower the step size"
    ):
        _run(prepared / "drive", home, "field", recipe)
    saved = home / "tiny" / ".work" / "field" / "wild" / "0" / "lidar.safetensors"
    assert not saved.exists() or all(
        bool(torch.isfinite(value).all()) for value in load_tensors(saved)[0].values()
    )


def test_a_checkpoint_of_another_drive_is_left_aside(
    prepared: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        _break(patch, residual_training, "lidar_step", _into_weights)
        with pytest.raises(DivergedError):
            _run(prepared / "drive", home, "field", RESIDUAL)
    record = home / "tiny" / "evidence" / "stage.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"files": {}}))  # other content
    said: list[str] = []
    _run(prepared / "drive", home, "field", RESIDUAL, said)
    assert any("left aside: of another recipe or of other inputs" in line for line in said)
    assert not any("resumed" in line for line in said)
