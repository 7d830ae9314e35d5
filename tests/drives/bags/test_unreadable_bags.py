"""A bag that cannot be read says why, and what to do: packed files, a machine's limits, damage."""

import errno
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from nvsf_core.drives.bags.index import read_fault
from nvsf_core.drives.detect import whole_drive
from nvsf_core.errors import DataError
from tests.drives.bags.small_bag import moving_lidar, rosbag2, write_bag


def test_a_bag_of_packed_files_is_refused_with_the_command_that_unpacks_it(tmp_path: Path) -> None:
    place = tmp_path / "a bag"
    write_bag(place, moving_lidar(), packed=rosbag2.CompressionMode.FILE)
    with pytest.raises(DataError, match="found `compression_mode: file`; unpack it once") as caught:
        whole_drive(place, "bag")
    words = str(caught.value)
    command = shlex.split(words[words.index("rosbags-convert") : words.index(" (or")])
    subprocess.run([Path(sys.executable).with_name(command[0]), *command[1:]], check=True)
    assert whole_drive(Path(command[-1]), "bag").last_frame == 3


def test_a_full_disk_is_no_damaged_bag(tmp_path: Path) -> None:
    full = read_fault(tmp_path, OSError(errno.ENOSPC, "No space left on device"), "copy it again")
    assert "No space left on device" in str(full) and "copy it again" not in str(full)
    damaged = read_fault(tmp_path, OSError(errno.EINVAL, "Invalid argument"), "copy it again")
    assert "copy it again" in str(damaged)


def test_a_pipe_in_a_bag_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", moving_lidar(), is_mcap=True)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(DataError, match=f"{file.name}: expected a regular file"):
        whole_drive(tmp_path / "bag", "bag")
