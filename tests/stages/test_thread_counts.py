"""A scene has the same bits whatever the number of threads: evidence, weights, scans and images."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry, ViewEntry
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import CameraSpec, PanoSpec, ResidualRecipe, TrainingSpec
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.thread_count import VARIABLE

UPSTREAM = ("frames", "sweeps", "mesh", "pano", "undistorted")


def residual() -> ResidualRecipe:
    """A few steps of all parts that `lean` has."""
    few = TrainingSpec(steps=3, rays=600)
    smoke = preset("smoke")
    assert isinstance(smoke, ResidualRecipe) and smoke.hits is not None
    return replace(
        smoke, name="all_parts", lidar_training=few, depth_training=few,
        hits=replace(smoke.hits, training=few),
        pano=PanoSpec(phases=1, parts=2, channels=8, layers=2, frames=3, judge_every=2, training=few),
        camera=CameraSpec(aligned=True),
    )  # fmt: skip


def paper() -> PaperRecipe:
    """A few steps of the paper's system, with its U-Net."""
    recipe = preset("paper_smoke")
    assert isinstance(recipe, PaperRecipe)
    return recipe


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneEntry:
    root = tmp_path_factory.mktemp("threads") / "drive"
    write_demo(root, size=DemoSize.tiny())
    view = ViewEntry(name="aside", scenes=("tiny",), shift_m=(0.0, 1.0, 0.0), frames=(1,))
    return SceneEntry(
        name="tiny", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,),
        views=(view,),
    )  # fmt: skip


@pytest.fixture(scope="module")
def upstream(scene: SceneEntry) -> Path:
    """A home with everything before `evidence`."""
    home = scene.root.parent / "home"
    run = plan_run(scene, home, recipe=residual())
    for stage in UPSTREAM:
        run_named_stage(stage, run, lambda line: None)
    return home


def outputs(scene: SceneEntry, home: Path, recipe: Recipe, stages: tuple[str, ...]) -> dict[str, bytes]:
    """All numbers that the stages wrote, by file; not their times."""
    run = plan_run(scene, home, recipe=recipe)
    found = {}
    for stage in stages:
        folder = run_named_stage(stage, run, lambda line: None).path
        for path in sorted(folder.rglob("*")):
            is_number = (
                path.suffix in (".safetensors", ".bin", ".png") or path.parent.parent.suffix == ".zarr"
            )
            if path.is_file() and is_number and "seconds" not in str(path):
                found[f"{stage}/{path.relative_to(folder)}"] = path.read_bytes()
    return found


@pytest.mark.parametrize(
    ("recipe", "stages"),
    [(residual(), ("evidence", "field", "novel_views")), (paper(), ("evidence", "field"))],
    ids=lambda value: value.name if isinstance(value, Recipe) else "",
)
def test_one_two_and_four_threads_give_the_same_bits(recipe, stages, scene, upstream, tmp_path, monkeypatch):
    found = []
    for threads in ("1", "2", "4"):
        monkeypatch.setenv(VARIABLE, threads)
        home = tmp_path / threads
        shutil.copytree(upstream, home)
        found.append(outputs(scene, home, recipe, stages))
    assert any(name.endswith("weights.safetensors") for name in found[0])
    assert any(name.startswith("evidence") for name in found[0])
    for other in found[1:]:
        assert other.keys() == found[0].keys()
        assert [name for name in other if other[name] != found[0][name]] == []
