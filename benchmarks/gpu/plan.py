"""Sizes of the measurements: the full one, and a small one that a CPU finishes in seconds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.kernels.encodings.hash_grid import GridLayout
from nvsf_core.recipe.base import Recipe
from nvsf_core.recipe.paper import PaperRecipe
from nvsf_core.recipe.presets import preset
from nvsf_core.recipe.residual import ResidualRecipe, TrainingSpec

LAYOUTS = {
    "8 levels, F 2, T 2^17, 16..2048": GridLayout(8, 2, 17, 16, 2048),
    "8 levels, F 4, T 2^19, 16..2048": GridLayout(8, 4, 19, 16, 2048),
    "paper: 8 levels, F 4, T 2^19, 512..32768": GridLayout(8, 4, 19, 512, 32768),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Sizes of all parts."""

    home: Path
    """Outputs of stages and trainings."""
    tests: tuple[str, ...]
    """Files and folders of tests."""
    layouts: Mapping[str, GridLayout]
    points: int
    """That a call of a kernel is given."""
    repeats: int
    """Timed calls of a kernel."""
    paper: PaperRecipe
    rays_at_once: tuple[int, ...]
    iterations: int
    """Timed, for each number of rays at once."""
    ours: tuple[Recipe, ...]
    """Trained with their own number of steps."""
    minutes: float
    """That `paper` is trained for."""
    scenes: tuple[SceneEntry, ...]


def full_plan(home: Path, scenes: tuple[SceneEntry, ...], minutes: float) -> Plan:
    """On a machine with a GPU."""
    folders = ("kernels", "encodings", "fields", "sampling", "losses", "rendering", "training", "models")
    return Plan(
        home=home, tests=tuple(f"tests/{folder}" for folder in folders), layouts=LAYOUTS, points=1 << 20,
        repeats=50, paper=_paper("paper"), rays_at_once=(256, 512, 1024, 2048), iterations=20,
        ours=(preset("quick"), preset("lean")), minutes=minutes, scenes=scenes,
    )  # fmt: skip


def smoke_plan(folder: Path) -> Plan:
    """Every part, tiny, on whatever device there is; writes its own drive into the folder."""
    write_demo(folder / "drive", size=DemoSize.tiny())
    scene = SceneEntry(
        name="tiny", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3,
        test_frames=(2,),
    )  # fmt: skip
    paper = _paper("paper_smoke")
    smoke, few = preset("smoke"), TrainingSpec(steps=2, rays=64)
    assert isinstance(smoke, ResidualRecipe)
    smoke = replace(smoke, lidar_training=few, depth_training=few)
    return Plan(
        home=folder / "home", tests=("tests/encodings/test_directions.py",),
        layouts={"tiny": GridLayout(2, 4, 8, 16, 64)}, points=64, repeats=1,
        paper=replace(paper, sampling=replace(paper.sampling, rays=16)), rays_at_once=(8, 16), iterations=1,
        ours=(smoke,), minutes=0.01, scenes=(scene,),
    )  # fmt: skip


def _paper(name: str) -> PaperRecipe:
    recipe = preset(name)
    assert isinstance(recipe, PaperRecipe)
    return recipe
