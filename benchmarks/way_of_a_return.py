"""How far a return travels through the code, from a recorded `.bin` to an exported one.

``python -m benchmarks.way_of_a_return`` trains `lean` and `paper`, cut to a few steps, on a short drive of a
LiDAR alone, and notes each function of the core when it is first entered, in the stages that a return passes.
It prints how many files were entered, how often the next file lies in another folder than the one before, and
how often that folder belongs to a higher layer (a climb). What only names, stores, asks for room on the disk,
records, checks or draws is not counted, nor are the baselines that are exported beside the model.
"""

import itertools
import pkgutil
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import nvsf_core
from benchmarks.common.documents import ROOT
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.recipe import Recipe, ResidualRecipe, TrainingSpec, preset
from nvsf_core.stages import STAGE_NAMES, plan_run, run_named_stage
from nvsf_core.stages.runner.stage import UnsoundOutputError

CORE = ROOT / "nvsf_core"
NOT_COUNTED = (
    "_types.py", "errors.py", "names.py", "recipe/", "stores/", "reporting/", "stages/runner/",
    "stages/checks/", "stages/sizes.py", "metrics/norms.py", "kernels/threads.py", "thread_count.py",
    "clouds/", "models/baselines/", "stages/mesh.py", "stages/views/camera.py",
)  # fmt: skip
_PASSED = ("frames", "sweeps", "evidence", "field", "novel_views")
_FRAMES, _LASERS, _FIRINGS = 9, tuple(range(0, 64, 4)), 360
_OPTIMIZED = 0x1
"""Flag of a function's code; a class's body, which runs when its module is imported, has it not."""


def main() -> None:
    """Trace and print, a line a recipe."""
    for recipe in (_short_lean(), replace(preset("paper_smoke"), name="paper_short")):
        with tempfile.TemporaryDirectory() as folder:
            files = traced(Path(folder), recipe)
        folders = [str(Path(file).parent) for file in files]
        changes = [(a, b) for a, b in itertools.pairwise(folders) if a != b]
        level = _levels()
        climbs = sum(level[b.split("/")[0]] > level[a.split("/")[0]] for a, b in changes)
        print(f"{recipe.name}: {len(files)} files, {len(changes)} changes of folder, {climbs} climbs")


def traced(folder: Path, recipe: Recipe) -> list[str]:
    """Files of the core, in the order in which the recipe's run first enters a function of each."""
    # What runs when a module is imported is on nobody's way.
    for module in pkgutil.walk_packages(nvsf_core.__path__, "nvsf_core."):
        if "triton" not in module.name:
            import_module(module.name)
    size = DemoSize(
        frames=_FRAMES, lasers=_LASERS, firings=_FIRINGS, cameras=("image_00",), width=32, height=16,
        fisheye_side=0,
    )  # fmt: skip
    write_demo(folder / "drive", size=size, traffic=1)
    shutil.rmtree(folder / "drive/data_2d_raw")
    scene = SceneEntry(
        name="short", root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=_FRAMES - 1,
        test_frames=(4,), sweep_period_s=0.1,
    )  # fmt: skip
    run = plan_run(scene, folder / "home", recipe=recipe)
    # After so few steps a field may expect no return at all, which a check then refuses.
    entered: list[str] = []
    with suppress(UnsoundOutputError):
        for stage in STAGE_NAMES[: STAGE_NAMES.index("novel_views") + 1]:
            with _noting() as noted:
                run_named_stage(stage, run, lambda _: None)
            entered += noted if stage in _PASSED else []
    return [file for file in dict.fromkeys(entered) if not file.startswith(NOT_COUNTED)]


@contextmanager
def _noting() -> Iterator[list[str]]:
    """Notes the file of each function of the core that is entered for the first time."""
    seen: set[Any] = set()
    entered: list[str] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code not in seen:
            seen.add(code)
            if code.co_flags & _OPTIMIZED and code.co_filename.startswith(str(CORE)):
                entered.append(Path(code.co_filename).relative_to(CORE).as_posix())

    sys.setprofile(note)
    try:
        yield entered
    finally:
        sys.setprofile(None)


def _short_lean() -> ResidualRecipe:
    lean = preset("lean")
    assert isinstance(lean, ResidualRecipe) and lean.hits is not None and lean.pano is not None
    few = TrainingSpec(steps=3, rays=256)
    return replace(
        lean, name="lean_short", lidar_training=few, hits=replace(lean.hits, frames=2, training=few),
        pano=replace(lean.pano, frames=4, phases=1, training=few),
    )  # fmt: skip


def _levels() -> dict[str, int]:
    """Folder of the core to its layer, the higher the later it is built."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (one["layers"] for one in contracts if one["name"] == "nvsf_core folders build upwards")
    named = [row.replace(":", "|").split("|") for row in layers]
    return {name.strip(): -number for number, row in enumerate(named) for name in row} | {".": -len(named)}


if __name__ == "__main__":
    main()
