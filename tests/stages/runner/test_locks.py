"""Two runs of one scene at once: the second one waits, and then finds the output up to date."""

import threading
import time
from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import SceneEntry, load_catalogue
from nvsf_core.errors import StoreError
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner.locks import file_lock, output_locks
from nvsf_core.stages.runner.stage import Stage, StageOutput, Task


@pytest.fixture
def entry(tiny_catalogue: Path) -> SceneEntry:
    return next(one for one in load_catalogue([tiny_catalogue], None) if one.name == "tiny")


def test_a_second_run_waits_and_makes_nothing_again(entry: SceneEntry, tmp_path: Path) -> None:
    made: list[str] = []
    has_begun, may_end = threading.Event(), threading.Event()

    def run(task: Task) -> StageOutput:
        made.append(task.scene.name)
        has_begun.set()
        assert may_end.wait(30)
        (task.folder / "rows").write_text("1")
        return StageOutput()

    stage = Stage(name="a", group="ingest", inputs=(), description="a", version="1", run=run)
    said: list[str] = []
    outcomes = {}

    def start(name: str) -> None:
        outcomes[name] = run_named_stage("a", plan_run(entry, tmp_path), said.append, stages=[stage])

    first, second = (threading.Thread(target=start, args=(name,)) for name in ("first", "second"))
    first.start()
    assert has_begun.wait(30)
    second.start()
    while not any("waiting for a, which another run writes" in line for line in said):
        time.sleep(0.02)
    may_end.set()
    first.join()
    second.join()
    assert made == ["tiny"] and not outcomes["first"].skipped and outcomes["second"].skipped


def test_readers_share_and_a_writer_waits_for_all_of_them(tmp_path: Path) -> None:
    said: list[str] = []
    with (
        output_locks(tmp_path, None, ["frames", "sweeps"], said.append),
        output_locks(tmp_path, "pano", ["frames"], said.append),
    ):
        assert said == []
        writer = threading.Thread(target=_hold, args=(tmp_path / "frames.lock", said))
        writer.start()
        while not said:
            time.sleep(0.02)
        assert said[0].startswith("waiting for frames") and "held" not in said
    writer.join()
    assert said[-1] == "held"


def _hold(path: Path, said: list[str]) -> None:
    with file_lock(path, said.append, "frames"):
        said.append("held")


def test_what_takes_a_lock_s_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "frames.lock").mkdir()
    with (
        pytest.raises(StoreError, match="expected a lock file"),
        file_lock(tmp_path / "frames.lock", str, ""),
    ):
        pass
