"""Arguments and environment variables that no run can be made with. One row a case."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from assets.workspace import Workspace
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry, load_catalogue
from nvsf_core.errors import (
    CalibrationError,
    DataError,
    DivergedError,
    MissingLibraryError,
    NvsfError,
    RecipeError,
    StoreError,
)
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.metrics import lpips
from nvsf_core.recipe.presets import preset
from nvsf_core.rendering.warping import sample
from nvsf_core.stages import find_scene, plan_run, run_scene
from nvsf_core.stages.runner.run import write_demo_where_absent
from nvsf_core.stores.checkpoints import save_tensors
from nvsf_core.stores.scene_store import SceneStore
from pipelines.executors import executor_from_environment
from tests.hostile import harm


@pytest.fixture
def street(tiny_catalogue: Path) -> SceneEntry:
    return next(entry for entry in load_catalogue([tiny_catalogue], None) if entry.name == "tiny")


CHOICES: list[tuple[str, dict[str, Any], str]] = [
    ("a negative seed", {"seed": -1}, "seed: expected a whole number"),
    ("a seed beyond 32 bits", {"seed": 2**32}, "seed: expected a whole number"),
    ("half a seed", {"seed": 1.5}, "seed: expected a whole number"),
    ("true for a seed", {"seed": True}, "seed: expected a whole number"),
    ("a seed as text", {"seed": "0"}, "seed: expected a whole number"),
    ("a draw of another drawer", {"draw_seed": -7}, "draw_seed: expected"),
    ("a label that climbs", {"dataset_label": "/../../victim"}, "dataset_label: a name is a folder"),
    ("an absolute label", {"dataset_label": "/tmp"}, "dataset_label: a name is a folder"),
    ("an empty label", {"dataset_label": ""}, "dataset_label: a name is a folder"),
    ("a label with a NUL", {"dataset_label": "a\0"}, "dataset_label"),
    ("an over-long label", {"dataset_label": "w" * 300}, "at most 100"),
    ("a recipe that is none", {"recipe": "../lean"}, "no recipe"),
]


@pytest.mark.parametrize(("choice", "words"), [c[1:] for c in CHOICES], ids=[c[0] for c in CHOICES])
def test_a_run_that_cannot_be_is_refused_before_it_begins(
    street: SceneEntry, tmp_path: Path, choice: dict[str, Any], words: str
) -> None:
    with pytest.raises(NvsfError, match=words):
        run_scene(street, tmp_path / "home", **choice)
    assert not (tmp_path / "home").exists()


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("SEED", "1.5", "SEED: expected a whole number"),
        ("SEED", "-1", "SEED: expected a whole number"),
        ("SEED", "\u0663", "SEED: expected a whole number"),
        ("SEED", "9" * 5000, "SEED: expected a whole number"),
        ("RECIPE", "quick/../../x", "no recipe"),
        ("NVSF_HOME", "/dev/null", "NVSF_HOME.*no folder"),
        ("NVSF_HOME", "/proc/nothing/here", "NVSF_HOME"),
        ("NVSF_HOME", "/" + "a" * 5000, "NVSF_HOME"),
        ("NVSF_LPIPS_WEIGHTS", "/nowhere/weights.safetensors", "NVSF_LPIPS_WEIGHTS=.*no such file"),
    ],
)
def test_the_environment_is_refused_when_the_run_is_read(
    tiny_catalogue: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, words: str
) -> None:
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    monkeypatch.setenv(variable, value)
    for ask in (lambda: Workspace().plan("tiny"), lambda: Workspace().require_possible()):
        with pytest.raises(NvsfError, match=words):
            ask()


def test_a_recipes_name_is_a_folders() -> None:
    with pytest.raises(RecipeError, match="a name is a folder"):
        replace(preset("lean"), name="../../victim")


def test_times_outside_of_the_drive_are_refused_before_training(street: SceneEntry, tmp_path: Path) -> None:
    late = replace(street, views=(ViewEntry(name="late", times_s=(0.1, 3020.5)),))
    with pytest.raises(NvsfError, match=r"view late: expected times from 0 to 0.3.*3020.5"):
        plan_run(late, tmp_path)


def test_a_scene_of_ones_own_is_held_to_the_same_rule(street: SceneEntry) -> None:
    for wrong in ({"name": "../x"}, {"sequence": "a/b"}, {"name": "drives"}, {"last_frame": 10**9}):
        with pytest.raises(NvsfError):
            replace(street, **wrong)


@pytest.mark.parametrize("name", [3, None, Path("demo")])
def test_a_scenes_name_is_text(name: Any) -> None:
    with pytest.raises(DataError, match="expected a scene's name as text, found "):
        find_scene(name)


def test_the_demo_is_never_written_for_somebodys_own_drive(street: SceneEntry, tmp_path: Path) -> None:
    own = replace(street, name="demo", root=tmp_path / "mine", sequence="my_drive")
    write_demo_where_absent(own, lambda line: None)
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("relative", ["../victim", "/victim", "a/../../victim", "", "a\0b"])
def test_an_output_lies_in_its_scenes_folder(tmp_path: Path, relative: str) -> None:
    store = SceneStore(home=tmp_path / "home", scene="s")
    for ask in (store.path, store.require):
        with pytest.raises(StoreError):
            ask(relative)
    assert list(tmp_path.iterdir()) == []


def test_a_link_out_of_the_scenes_folder_is_refused_and_what_it_leads_to_stays(tmp_path: Path) -> None:
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "kept").write_text("1")
    store = SceneStore(home=tmp_path / "home", scene="s")
    store.root.mkdir(parents=True)
    (store.root / "pano").symlink_to(tmp_path / "victim")
    with pytest.raises(StoreError, match="out of"), store.publish("pano"):
        pass
    assert (tmp_path / "victim" / "kept").is_file()


@pytest.mark.parametrize("scene", ["..", "a/b", "", "benchmark_report", "drives", "dagster", ".hidden"])
def test_a_store_has_a_folder_of_its_own(tmp_path: Path, scene: str) -> None:
    with pytest.raises(StoreError):
        SceneStore(home=tmp_path, scene=scene)


def test_a_coordinate_that_is_not_finite_never_reaches_grid_sample() -> None:
    grid = torch.zeros(4, 4, 2)
    grid[1, 2, 0] = float("nan")
    with pytest.raises(DivergedError, match=r"coordinates of warped pixels.*index"):
        sample(torch.zeros(3, 8, 8, requires_grad=True), grid)


@pytest.mark.parametrize(
    "wrong", [{"fx": 1e-300}, {"fy": 1e9}, {"cx": 1e6}, {"width": 64.5}, {"height": 0}, {"width": 10**9}]
)
def test_a_camera_that_nobody_could_build_is_refused(wrong: dict[str, float]) -> None:
    whole: dict[str, Any] = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    with pytest.raises(CalibrationError, match=r"expected .* found"):
        Pinhole(**(whole | wrong))


@pytest.mark.parametrize("name", ["ray", "k8s"])
def test_an_extra_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("NVSF_EXECUTOR", name)
    monkeypatch.setitem(sys.modules, {"ray": "dagster_ray", "k8s": "dagster_k8s"}[name], None)
    with pytest.raises(MissingLibraryError, match=rf"pip install -e '\.\[{name}\]'"):
        executor_from_environment()


@pytest.mark.parametrize("done", [harm.cut, harm.empty, harm.text("no weights")])
def test_damaged_weights_of_lpips_name_their_file_before_a_run_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: harm.Harm
) -> None:
    path = tmp_path / "weights.safetensors"
    save_tensors(path, {"shift": torch.zeros(1, 3, 1, 1)})
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(path))
    for harmed in (lambda _: None, done):  # names of another network; no weights at all
        harmed(path)
        with pytest.raises(StoreError, match=rf"LPIPS weights .*{path.name}.*unset"):
            lpips.load_lpips()
        with pytest.raises(StoreError, match=f"LPIPS weights .*{path.name}"):
            Workspace().require_possible()


def test_seeds_of_numpy_are_refused_as_what_they_are(street: SceneEntry, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"np\.int64"):
        plan_run(street, tmp_path, seed=np.int64(3))
