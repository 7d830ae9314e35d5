"""Leftovers of dead writers are known, and those of living ones and of other machines are left alone."""

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from nvsf_core.stores import writers
from nvsf_core.stores.scene_store import SceneStore, new_folder, publish_folder
from nvsf_core.stores.writers import is_left, mark_of, own_mark

MARK = "from nvsf_core.stores.writers import own_mark; print(own_mark())"


@pytest.fixture
def dead_mark(repo: Path) -> str:
    done = subprocess.run([sys.executable, "-c", MARK], cwd=repo, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_living_writer_is_not_dead_and_a_dead_one_is(tmp_path: Path, dead_mark: str) -> None:
    assert not is_left(own_mark(), tmp_path)
    assert is_left(dead_mark, tmp_path)


def test_a_later_process_of_the_same_number_is_another_one(tmp_path: Path) -> None:
    machine, number, start, chance = own_mark().split("-")
    assert is_left(f"{machine}-{number}-{int(start) - 1}-{chance}", tmp_path)


def test_a_writer_elsewhere_is_dead_after_a_day_without_a_change(
    tmp_path: Path, dead_mark: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = re.sub("^[0-9a-f]{8}", "00000000", dead_mark)
    (tmp_path / "half").write_text("1")
    assert not is_left(elsewhere, tmp_path)
    tomorrow_s = time.time() + writers.FORGOTTEN_S + 10.0
    monkeypatch.setattr(writers.time, "time", lambda: tomorrow_s)
    assert is_left(elsewhere, tmp_path)


@pytest.mark.parametrize("filled", [publish_folder, new_folder])
def test_a_living_writer_that_writes_elsewhere_for_days_is_not_forgotten(
    filled: Callable[[Path], AbstractContextManager[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writers, "_TOUCHED_EVERY_S", 0.01)
    with filled(tmp_path / "field") as folder:
        made_ns, deadline_s = folder.stat().st_ctime_ns, time.monotonic() + 60.0
        while folder.stat().st_ctime_ns == made_ns:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("touches")]
    assert (tmp_path / "field").is_dir()


def test_a_mark_is_read_from_a_name_and_nothing_else_is_one(dead_mark: str) -> None:
    assert mark_of(f".publishing-manual-64254140-{dead_mark}") == dead_mark
    assert mark_of(".publishing-pano-odd-name") is None


def test_whoever_writes_in_a_folder_removes_all_that_the_dead_left_there(
    tmp_path: Path, dead_mark: str
) -> None:
    store = SceneStore(home=tmp_path, scene="s")
    versions = store.path("dataset/left")
    for mark in (dead_mark, own_mark()):
        (versions / f".publishing-manual-{mark}").mkdir(parents=True)
    with store.publish("dataset/left/weekly") as folder:
        (folder / "scan").write_text("1")
    assert sorted(mark_of(name) == dead_mark for name in os.listdir(versions)) == [False, False]
