"""Hashes are of content, remembered while nothing says that a file changed, and never believed too early."""

import hashlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nvsf_core.stores.file_hashes import TICK_NS, FileHashes, TimeIsUpError

MANY_WRITERS = """
import sys
from pathlib import Path
from nvsf_core.stores.file_hashes import FileHashes
folder, mine = Path(sys.argv[1]), sys.argv[2]
for number in range(20):
    path = folder / f"{mine}-{number}"
    path.write_text(path.name)
    with FileHashes(folder / "hashes.json") as hashes:
        hashes.hash_of(path)
"""


def _old(path: Path, content: str) -> Path:
    """A file whose times lie well before now, as far as they can be set (a change time cannot)."""
    path.write_text(content)
    os.utime(path, (1.0, 1.0))
    return path


def _sha(content: str) -> str:
    return hashlib.sha256(content.encode()).hexdigest()


@pytest.fixture
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the reader runs two ticks ahead, as if every file had been written before."""
    now = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now() + 2 * TICK_NS)


@pytest.mark.usefixtures("settled")
def test_an_unchanged_file_is_read_once(tmp_path: Path) -> None:
    path = _old(tmp_path / "a", "one")
    for expected in (3, 0):
        with FileHashes(tmp_path / "hashes.json") as hashes:
            assert hashes.hash_of(path) == _sha("one") and hashes.bytes_read == expected


@pytest.mark.usefixtures("settled")
def test_a_change_that_keeps_size_and_modification_time_is_seen(tmp_path: Path) -> None:
    path = _old(tmp_path / "a", "one")
    with FileHashes(tmp_path / "hashes.json") as hashes:
        hashes.hash_of(path)
    _old(path, "two")
    with FileHashes(tmp_path / "hashes.json") as hashes:
        assert hashes.hash_of(path) == _sha("two")


def test_a_file_that_was_just_written_is_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("one")
    for _ in range(2):
        with FileHashes(tmp_path / "hashes.json") as hashes:
            hashes.hash_of(path)
            assert hashes.bytes_read == 3
    # A change within the clock's tick: all that is compared is made to look the same.
    found = path.stat()
    entry = json.loads((tmp_path / "hashes.json").read_text())["files"][str(path)]
    path.write_text("two")
    entry[:4] = [found.st_size, path.stat().st_mtime_ns, path.stat().st_ctime_ns, found.st_ino]
    (tmp_path / "hashes.json").write_text(json.dumps({"files": {str(path): entry}}))
    with FileHashes(tmp_path / "hashes.json") as hashes:
        assert hashes.hash_of(path) == _sha("two")


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("damage", ["", "{", "[]", '{"files": [1]}', '{"files": {"a": [1, "x"]}}', "\0\0"])
def test_a_damaged_memory_is_written_anew(tmp_path: Path, damage: str) -> None:
    path, document = _old(tmp_path / "a", "one"), tmp_path / "hashes.json"
    document.write_text(damage)
    for expected in (3, 0):
        with FileHashes(document) as hashes:
            assert hashes.hash_of(path) == _sha("one") and hashes.bytes_read == expected


def test_several_processes_lose_nothing_of_each_other(repo: Path, tmp_path: Path) -> None:
    running = [
        subprocess.Popen([sys.executable, "-c", MANY_WRITERS, str(tmp_path), name], cwd=repo)
        for name in ("a", "b", "c")
    ]
    assert [process.wait() for process in running] == [0, 0, 0]
    files = json.loads((tmp_path / "hashes.json").read_text())["files"]
    assert {Path(name).name: entry[-1] for name, entry in files.items()} == {
        f"{name}-{number}": _sha(f"{name}-{number}") for name in "abc" for number in range(20)
    }


@pytest.mark.usefixtures("settled")
def test_all_is_read_anew_where_that_is_asked_for(tmp_path: Path) -> None:
    path = _old(tmp_path / "a", "one")
    for anew, expected in ((False, 3), (True, 3), (False, 0)):
        with FileHashes(tmp_path / "hashes.json", read_anew=anew) as hashes:
            hashes.hash_of(path)
            assert hashes.bytes_read == expected


@pytest.mark.usefixtures("settled")
def test_what_was_read_in_time_is_remembered(tmp_path: Path) -> None:
    path, later = _old(tmp_path / "a", "one"), _old(tmp_path / "b", "two")
    with pytest.raises(TimeIsUpError), FileHashes(tmp_path / "hashes.json") as hashes:
        hashes.hash_of(path)
        hashes.until_s = 0.0
        hashes.hash_of(later)
    with FileHashes(tmp_path / "hashes.json", until_s=0.0) as hashes:
        assert hashes.hash_of(path) == _sha("one")
