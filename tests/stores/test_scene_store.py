"""A reader sees the old output or the new one, never half of one."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nvsf_core.errors import StoreError
from nvsf_core.stores.scene_store import SceneStore, new_folder

KILLED_WRITER = """
import sys, time
from pathlib import Path
import numpy as np
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.scene_store import SceneStore
with SceneStore(home=Path(sys.argv[1]), scene="s").publish("pano") as folder:
    write_arrays(folder / "pano.zarr", {"range_m": np.ones((4, 8), np.float32)})
    (folder / "half").write_text("half")
    Path(sys.argv[1], "writing").write_text("")
    time.sleep(60)
"""


@pytest.fixture
def store(tmp_path):
    return SceneStore(home=tmp_path, scene="s")


def _kill_a_writer(home):
    writer = subprocess.Popen([sys.executable, "-c", KILLED_WRITER, str(home)])
    deadline_s = time.monotonic() + 60
    while not (home / "writing").exists():
        assert writer.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.02)
    os.kill(writer.pid, signal.SIGKILL)
    writer.wait()


def test_a_killed_writer_publishes_nothing(store, tmp_path):
    _kill_a_writer(tmp_path)
    with pytest.raises(StoreError, match="pano"):
        store.require("pano")


def test_a_killed_writer_leaves_the_old_output(store, tmp_path):
    with store.publish("pano") as folder:
        (folder / "old").write_text("whole")
    _kill_a_writer(tmp_path)
    assert [path.name for path in store.require("pano").iterdir()] == ["old"]


def test_the_next_writer_removes_what_a_killed_one_left(store, tmp_path):
    _kill_a_writer(tmp_path)
    with store.publish("pano") as folder:
        (folder / "new").write_text("whole")
    assert [path.name for path in store.root.iterdir()] == ["pano"]
    assert [path.name for path in store.require("pano").iterdir()] == ["new"]


def test_who_reads_an_output_removes_what_a_killed_writer_left_beside_it(store, tmp_path):
    with store.publish("pano") as folder:
        (folder / "old").write_text("whole")
    _kill_a_writer(tmp_path)
    assert len(list(store.root.iterdir())) == 2
    store.require("pano")
    assert [path.name for path in store.root.iterdir()] == ["pano"]


def test_an_error_while_writing_leaves_the_old_output(store):
    with store.publish("pano") as folder:
        (folder / "old").write_text("whole")
    with pytest.raises(ZeroDivisionError), store.publish("pano") as folder:
        (folder / "new").write_text(str(1 / 0))
    assert [path.name for path in store.root.iterdir()] == ["pano"]
    assert (store.require("pano") / "old").read_text() == "whole"


def test_a_death_between_the_two_renames_is_undone(store):
    with store.publish("pano") as folder:
        (folder / "old").write_text("whole")
    store.path("pano").rename(store.root / ".retired-pano-0123abcd")
    with pytest.raises(ZeroDivisionError), store.publish("pano"):
        raise ZeroDivisionError
    assert (store.require("pano") / "old").read_text() == "whole"


def test_a_nested_output_lies_where_it_says(store):
    with store.publish("field/quick/0") as folder:
        (folder / "weights").write_text("1")
    assert store.require("field/quick/0") == store.home / "s/field/quick/0"


def test_a_new_folder_is_there_when_it_is_whole_and_an_empty_one_is_filled(
    tmp_path: Path,
) -> None:
    absent, empty = tmp_path / "a/absent", tmp_path / "empty"
    empty.mkdir()
    before = empty.stat().st_ino
    for target in (absent, empty):
        with new_folder(target) as folder:
            (folder / "part").mkdir()
            (folder / "part/file").write_text("whole")
            assert not (target / "part").exists()
        assert [one.name for one in target.iterdir()] == ["part"]
        assert (target / "part/file").read_text() == "whole"
    assert empty.stat().st_ino == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a", "empty"]


def test_a_new_folder_is_never_written_over_files_that_came_meanwhile(tmp_path: Path) -> None:
    for target in (tmp_path / "absent", tmp_path / "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(OSError, match="not empty"), new_folder(target) as folder:
            (folder / "file").write_text("ours")
            target.mkdir(exist_ok=True)
            (target / "file").write_text("theirs")
        assert (target / "file").read_text() == "theirs"
        assert [one.name for one in target.iterdir()] == ["file"]
