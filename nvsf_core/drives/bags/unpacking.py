"""Bounds on what a bag's packed parts may become in memory.

The package rosbags unpacks a part whole, whatever its size: a chunk of some kilobytes may become more than a
machine has. Its own functions for that are replaced by ones that stop.
"""

import bz2
import importlib
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

from nvsf_core.drives.kitti360.text import MIB
from nvsf_core.errors import DataError

_MOST_BYTES = 512 * MIB
"""Of one part: bags pack messages one by one, or in chunks of some MiB; the largest message is an image's."""
_STEP_BYTES = 16 * MIB


def bound_unpacking() -> None:
    """Have rosbags unpack at most `_MOST_BYTES` of a part.

    Raises:
        ImportError: The package rosbags is not installed.
    """
    ros1: Any = importlib.import_module("rosbags.rosbag1.reader")
    ros2: Any = importlib.import_module("rosbags.rosbag2.reader")
    mcap: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")
    lz4 = partial(unpacked, importlib.import_module("lz4.frame").LZ4FrameDecompressor)
    zstd = partial(unpacked, mcap.zstd.ZstdDecompressor)
    ros1.decompressors |= {"bz2": partial(unpacked, bz2.BZ2Decompressor), "lz4": lz4}
    mcap.DECOMPRESSORS |= {"lz4": lambda data, _: lz4(data), "zstd": lambda data, _: zstd(data)}
    # Of messages that are packed one by one.
    ros2.zstd = SimpleNamespace(decompress=zstd)


def unpacked(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """The unpacked bytes of one part, which may be several streams.

    Raises:
        DataError: They become more than `_MOST_BYTES`, or end in the middle.
    """
    parts, found, rest = list[bytes](), 0, data
    while rest:
        stream = decompressor()
        while not stream.eof:
            parts.append(stream.decompress(rest, max_length=_STEP_BYTES))
            found, rest = found + len(parts[-1]), b""
            if found > _MOST_BYTES:
                raise DataError(
                    f"expected parts of at most {_MOST_BYTES:,} bytes each, found one of {len(data):,} "
                    "packed bytes that becomes more; write the bag again, with smaller chunks"
                )
            if not stream.eof and stream.needs_input:
                raise DataError(f"a packed part of {len(data):,} bytes ends in the middle")
        rest = stream.unused_data or b""
    return b"".join(parts)
