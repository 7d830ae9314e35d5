"""A stage's scratch folder stays until its output is published: it holds hours of training."""

from dataclasses import replace
from pathlib import Path

import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Check, Stage, StageOutput, Task, UnsoundOutputError


def test_what_fails_after_its_work_finds_it_again(tmp_path: Path) -> None:
    write_demo(tmp_path / "drive", size=replace(DemoSize.tiny(), frames=1))
    scene = SceneEntry(
        name="tiny", root=tmp_path / "drive", sequence=DEMO_SEQUENCE, first_frame=0, last_frame=0,
        test_frames=(),
    )  # fmt: skip
    run = plan_run(scene, tmp_path / "home", recipe="smoke")
    kept = run.store.path(".work/a") / "checkpoint"
    passes: list[bool] = []

    def work(task: Task) -> StageOutput:
        passes.append((task.store.work_dir("a") / kept.name).exists())
        kept.write_text("hours")
        sound = Check(name="sound", passed=passes[-1], detail="as asked", blocking=True)
        return StageOutput(checks=[sound])

    stage = Stage(name="a", group="ingest", inputs=(), description="a", version="1", run=work)
    with pytest.raises(UnsoundOutputError):
        run_named_stage("a", run, lambda line: None, stages=[stage])
    assert kept.exists()
    run_named_stage("a", run, lambda line: None, stages=[stage])
    assert passes == [False, True] and not kept.parent.exists()
