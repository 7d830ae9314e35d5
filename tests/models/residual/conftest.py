"""The demo's drive as far as training reads it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.recipe.presets import preset
from nvsf_core.stages import SceneRun, plan_run, run_named_stage

Prepare = Callable[[str, DemoSize], SceneRun]


@pytest.fixture(scope="session")
def prepare(tmp_path_factory: pytest.TempPathFactory) -> Prepare:
    """Runs the stages before training on a demo of a size, all frames for training, in a folder of a name."""

    def prepared(name: str, size: DemoSize) -> SceneRun:
        folder: Path = tmp_path_factory.mktemp(name)
        write_demo(folder / "drive", size=size)
        scene = SceneEntry(
            name=name, root=folder / "drive", sequence=DEMO_SEQUENCE, first_frame=0,
            last_frame=size.frames - 1, test_frames=(), sweep_period_s=0.1,
        )  # fmt: skip
        run = plan_run(scene, folder / "home", recipe=preset("smoke"))
        for stage in ("frames", "sweeps", "undistorted", "evidence"):
            run_named_stage(stage, run, lambda _: None)
        return run

    return prepared
