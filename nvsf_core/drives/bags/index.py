"""What a bag holds: its topics, stamps, transforms and camera infos, found in one pass. No scan is kept."""

import errno
import functools
import importlib
import re
import shlex
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nvsf_core.drives.bags.definitions import bound_definitions, require_possible
from nvsf_core.drives.bags.messages import (
    CAMERA_INFO,
    IMAGES,
    KINDS,
    ODOMETRY,
    POINT_CLOUD,
    encoding_fault,
    stamp_s,
    tells_lasers,
)
from nvsf_core.drives.bags.transforms import TransformTree, plain_name, pose_of
from nvsf_core.drives.bags.unpacking import bound_unpacking
from nvsf_core.drives.kitti360.text import MIB, read_text
from nvsf_core.errors import DataError, MissingLibraryError

_FOREVER = "/tf_static"
_PACKED = re.compile(r"""^\s*compression_mode:\s*["']?file\b""", re.IGNORECASE | re.MULTILINE)
"""In `metadata.yaml`: its files are packed whole, and not each message."""
_MOST_METADATA_BYTES = MIB
"""Of a bag of thousands of files; YAML is read slowly, a megabyte in half a minute."""


@dataclass(slots=True)
class Stamped:
    """One message: the seconds of its header, and the nanoseconds under which the bag keeps it."""

    stamp_s: float
    kept_ns: int


@dataclass(slots=True)
class BagIndex:
    """The topics of a bag that drives are made of."""

    path: Path
    scans: dict[str, list[Stamped]] = field(default_factory=dict)
    images: dict[str, list[Stamped]] = field(default_factory=dict)
    tells_lasers: dict[str, bool] = field(default_factory=dict)
    """Topic of point clouds to whether the points of its first message have a laser or a time."""
    frame_ids: dict[str, str] = field(default_factory=dict)
    """Topic to the frame of its first message."""
    encoding_faults: dict[str, str | None] = field(default_factory=dict)
    """Topic of images to why its first one is of an encoding that is not read; None if it is read."""
    infos: dict[str, Any] = field(default_factory=dict)
    """Topic of camera infos to the first one."""
    tree: TransformTree = field(default_factory=lambda: TransformTree(Path()))
    faults: Counter[str] = field(default_factory=Counter)
    """Messages that cannot be read, by topic."""

    def lidar_topic(self, asked: str | None) -> str | None:
        """The topic of point clouds that is read; None if there is none.

        Clouds of depth cameras and radars, often the more, have points without laser and time.

        Args:
            asked: The topic that the scene names; None = those whose points have a laser or a time come
                first, then those with the most messages, then the first by name.

        Raises:
            DataError: The bag has no topic as asked for.
        """
        if asked is not None and asked not in self.scans:
            raise DataError(
                f"{self.path}: lidar_topic: expected one of the bag's topics of point clouds, "
                f"{', '.join(sorted(self.scans)) or 'of which there is none'!s:.300}, found {asked!r:.100}"
            )
        return asked or min(
            self.scans,
            key=lambda topic: (not self.tells_lasers.get(topic), -len(self.scans[topic]), topic),
            default=None,
        )


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """The bag's reader, of ROS 1 (`.bag`), ROS 2 (a folder with `metadata.yaml`), or MCAP.

    Raises:
        MissingLibraryError: The package rosbags is not installed.
        DataError: It is no bag, damaged, packed file by file, or the machine cannot read it.
    """
    _require_files(path)
    _require_unpacked(path)
    try:
        highlevel = importlib.import_module("rosbags.highlevel")
        typesys = importlib.import_module("rosbags.typesys")
        bound_unpacking()
        bound_definitions()
    except ImportError as error:
        raise MissingLibraryError(
            "bags are read by the package rosbags: pip install 'nvsf[rosbags]'"
        ) from error
    inside = path
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise DataError(f"{path}: expected metadata.yaml or one .mcap, found {len(files)} of these")
        inside = files[0]
    try:
        # Old bags hold no definitions of their messages: these are then of ROS 2 Humble.
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        reader = highlevel.AnyReader([inside], default_typestore=store)
        reader.open()
    except Exception as error:  # the library's errors on damaged bags have no common base
        damaged = f"cannot be read as a bag ({error!s:.200}); copy it again"
        raise read_fault(path, error, damaged) from error
    try:
        require_possible(str(path), KINDS, reader.typestore.fielddefs)
        yield reader
    finally:
        reader.close()


def _require_files(path: Path) -> None:
    """Refuse a pipe or a device, of which a read may not end: the library opens what a bag's folder holds.

    Raises:
        DataError: There is one; the message names it.
    """
    for one in sorted(path.iterdir()) if path.is_dir() else [path]:
        if one.exists() and not one.is_file() and not one.is_dir():
            raise DataError(f"{one}: expected a regular file, found a pipe or a device; copy the bag again")


def _require_unpacked(path: Path) -> None:
    """Refuse a bag whose files are packed whole: to read one message, all of it would be unpacked.

    Raises:
        DataError: It is of that kind; the message gives the command that unpacks it.
    """
    about = path / "metadata.yaml"
    try:
        is_packed = about.is_file() and bool(_PACKED.search(read_text(about, _MOST_METADATA_BYTES)))
    except (OSError, ValueError) as error:
        raise DataError(f"{about}: cannot be read ({error}); copy the bag again") from error
    if is_packed:
        source, unpacked = (shlex.quote(str(one)) for one in (path, path.with_name(f"{path.name}_unpacked")))
        raise DataError(
            f"{path}: expected a bag whose messages can be read one by one, found `compression_mode: file`; "
            f"unpack it once, and name the new one: rosbags-convert --src {source} --dst {unpacked} (or "
            "`ros2 bag convert`)"
        )


def read_fault(path: Path, error: Exception, damaged: str) -> DataError:
    """Why a bag cannot be read: what the machine says, as that its disk is full; else that it is damaged."""
    if isinstance(error, DataError):
        return DataError(f"{path}: {error}")
    # A damaged bag may say to read where no file can be (EINVAL); the library's own errors have no number.
    if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
        return DataError(
            f"{path}: cannot be read ({error.strerror}); check the disk, its space and the rights"
        )
    return DataError(f"{path}: {damaged}")


def index_of(path: Path) -> BagIndex:
    """The index of a bag, made once as long as its files stay the same.

    Raises:
        DataError: It cannot be read, or ends in the middle.
        MissingLibraryError: See `open_bag`.
    """
    files = [path] if path.is_file() else sorted(one for one in path.glob("*") if one.is_file())
    if not files:
        raise DataError(f"{path}: expected a bag, found nothing")
    return _index(path, tuple((one, one.stat().st_size, one.stat().st_mtime_ns) for one in files))


@functools.lru_cache(maxsize=4)
def _index(path: Path, _files: tuple[tuple[Path, int, int], ...]) -> BagIndex:
    index = BagIndex(path, tree=TransformTree(path))
    with open_bag(path) as reader:
        wanted = [one for one in reader.connections if one.msgtype in KINDS]
        try:
            for connection, kept_ns, raw in reader.messages(connections=wanted) if wanted else ():
                _take(index, reader, connection, kept_ns, raw)
        except Exception as error:  # as above
            damaged = (
                f"ends after {sum(map(len, index.scans.values()))} scans ({error!s:.200}); `rosbag reindex`, "
                "`mcap recover` or `ros2 bag reindex` mends what can be"
            )
            raise read_fault(path, error, damaged) from error
    index.tree.settle()
    for messages in (*index.scans.values(), *index.images.values()):
        messages.sort(key=lambda one: one.stamp_s)
    return index


def _take(index: BagIndex, reader: Any, connection: Any, kept_ns: int, raw: bytes) -> None:
    topic, kind = connection.topic, connection.msgtype
    try:
        if kind == POINT_CLOUD or kind in IMAGES:
            seconds, frame = header_of(raw, is_ros2=reader.is2)
            found = index.scans if kind == POINT_CLOUD else index.images
            found.setdefault(topic, []).append(Stamped(seconds, kept_ns))
            index.frame_ids.setdefault(topic, frame)
            if kind == POINT_CLOUD and topic not in index.tells_lasers:
                index.tells_lasers[topic] = tells_lasers(reader.deserialize(raw, kind))
            elif kind in IMAGES and topic not in index.encoding_faults:
                index.encoding_faults[topic] = encoding_fault(reader.deserialize(raw, kind))
            return
        if kind == CAMERA_INFO and topic in index.infos:
            return
        message = reader.deserialize(raw, kind)
        if kind == CAMERA_INFO:
            index.infos[topic] = message
        elif kind == ODOMETRY:
            pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
            index.tree.add(message.child_frame_id, message.header.frame_id, pose, stamp_s(message), topic)
        else:
            for one in message.transforms:
                pose = pose_of(one.transform.translation, one.transform.rotation)
                moment_s = None if topic.endswith(_FOREVER) else stamp_s(one)
                index.tree.add(one.child_frame_id, one.header.frame_id, pose, moment_s, topic)
    except Exception:  # counted and named; the other messages are read
        index.faults[topic] += 1


def header_of(raw: bytes, *, is_ros2: bool) -> tuple[float, str]:
    """Seconds and frame of a message's header, of its bytes alone.

    Raises:
        DataError: They are too few.
    """
    # CDR: 4 bytes of encapsulation. ROS 1: a number of the message.
    order = "<" if not is_ros2 or raw[1:2] in (b"\x01", b"\x03", b"\x07", b"\x09") else ">"
    if len(raw) < 16:
        raise DataError("expected a header, found a message that ends before")
    seconds, nanoseconds, length = struct.unpack_from(f"{order}III", raw, 4)
    if length > len(raw) - 16:
        raise DataError("expected a header, found a name that is longer than the message")
    return seconds + 1e-9 * nanoseconds, plain_name(
        raw[16 : 16 + length].rstrip(b"\0").decode("utf-8", "replace")
    )
