"""What is packed in a bag becomes no more in memory than any recording needs."""

import bz2
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.bags.unpacking import unpacked
from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.errors import DataError
from tests.drives.bags.small_bag import moving_lidar, write_bag

lz4 = pytest.importorskip("lz4.frame", reason="the extra `rosbags` is not installed")
storage_mcap = pytest.importorskip("rosbags.rosbag2.storage_mcap")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
ros1_reader = pytest.importorskip("rosbags.rosbag1.reader")
ros2_reader = pytest.importorskip("rosbags.rosbag2.reader")
zstd = storage_mcap.zstd

MIB = 1 << 20
KINDS = [
    (bz2.BZ2Decompressor, bz2.compress),
    (lz4.LZ4FrameDecompressor, lz4.compress),
    (zstd.ZstdDecompressor, zstd.compress),
]


@pytest.mark.parametrize(("decompressor", "compress"), KINDS)
def test_a_part_comes_back_whole_also_in_two_streams(
    decompressor: Callable[[], object], compress: Callable[[bytes], bytes]
) -> None:
    data = np.random.default_rng(0).integers(0, 9, MIB, np.uint8).tobytes() + bytes(40 * MIB)
    assert unpacked(decompressor, compress(data)) == data
    assert unpacked(decompressor, compress(b"first") + compress(b"second")) == b"firstsecond"
    with pytest.raises(DataError, match="ends in the middle"):
        unpacked(decompressor, compress(data)[:-9])


@pytest.mark.parametrize("compression", ["message", "storage"])
def test_packed_bags_are_read_as_before(tmp_path: Path, compression: str) -> None:
    mode = rosbag2.CompressionMode[compression.upper()]
    write_bag(tmp_path / "bag", moving_lidar(), packed=mode, is_mcap=compression == "storage")
    drive = drive_of(whole_drive(tmp_path / "bag", "bag"))
    assert [len(drive.decode_scan(frame).points) for frame in drive.frames] == [20] * 4


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_a_part_of_some_kilobytes_does_not_fill_the_memory(tmp_path: Path, kind: str) -> None:
    write_bag(tmp_path / "bag", moving_lidar())
    whole_drive(tmp_path / "bag", "bag")  # once a bag is opened, the library stops
    compress = {"bz2": bz2.compress, "lz4": lz4.compress, "zstd": zstd.compress}[kind]
    bomb = compress(bytes(20 * MIB)) * 30
    assert len(bomb) < 4 * MIB
    read = {
        "bz2": ros1_reader.decompressors["bz2"],
        "lz4": lambda data: storage_mcap.decompress(data, "lz4", 0, 0),
        "zstd": lambda data: storage_mcap.decompress(data, "zstd", 0, 0),
    }[kind]
    tracemalloc.start()
    with pytest.raises(DataError, match="expected parts of at most 536,870,912 bytes each"):
        read(bomb)
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_bytes < 600 * MIB
    assert ros1_reader.decompressors["lz4"].func is ros2_reader.zstd.decompress.func is unpacked
