"""The doctor's look at locks: taken for real here; other file systems by a table of mounts."""

from pathlib import Path

import pytest

from pipelines.doctor.locks import examine_locks, mount_of

TABLE = """/dev/vda / ext4 rw,relatime 0 0
server:/home /mnt/shared\\040home nfs4 rw,vers=4.2,local_lock=none 0 0
server:/old /mnt/old nfs rw,vers=3,nolock,local_lock=all 0 0
//server/x /mnt/windows cifs rw,nobrl 0 0
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    (tmp_path / "mounts").write_text(TABLE)
    return tmp_path / "mounts"


def test_here_files_are_locked_and_nothing_is_left(tmp_path: Path) -> None:
    is_fine, words = examine_locks(tmp_path)
    assert is_fine and "files are locked" in words
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_locked_is_said() -> None:
    is_fine, words = examine_locks(Path("/proc"))
    assert not is_fine and "cannot be locked" in words and "two runs of a scene would mix" in words


@pytest.mark.parametrize(
    ("place", "kind"),
    [
        ("/mnt/shared home/nvsf", "nfs4"),
        ("/mnt/old", "nfs"),
        ("/mnt/older", "ext4"),
        ("/mnt/windows/home", "cifs"),
    ],
)
def test_a_folder_s_mount_is_found(table: Path, place: str, kind: str) -> None:
    assert mount_of(Path(place), table)[0] == kind


@pytest.mark.parametrize(
    ("options", "is_fine", "words"),
    [
        ("rw,vers=4.2,local_lock=none", True, "from two machines"),
        ("rw,vers=3,local_lock=flock", False, "within this machine only"),
        ("rw,vers=3,nolock", False, "within this machine only"),
    ],
)
def test_a_mount_whose_locks_each_machine_has_for_itself_is_named(
    tmp_path: Path, options: str, is_fine: bool, words: str
) -> None:
    (tmp_path / "mounts").write_text(f"server:/home {tmp_path} nfs {options} 0 0\n")
    found = examine_locks(tmp_path, tmp_path / "mounts")
    assert found[0] is is_fine and words in found[1]
