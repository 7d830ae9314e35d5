"""What a bag says its messages are is held against what a message can be, before a reader is made of it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from nvsf_core.drives.bags.definitions import require_possible
from nvsf_core.drives.bags.messages import KINDS, POINT_CLOUD
from nvsf_core.drives.detect import whole_drive
from nvsf_core.errors import DataError
from tests.drives.bags.small_bag import moving_lidar, write_bag

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="the extra `rosbags` is not installed")
typesys = pytest.importorskip("rosbags.typesys")

Change = Callable[[str], str]
_END = "bool is_dense\n"
_PART = f"{'=' * 80}\nMSG: "


def _bag(path: Path, change: Change) -> Path:
    """A ROS 1 bag of a message, with its definition changed."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    definition = change(store.generate_msgdef(POINT_CLOUD, ros_version=1)[0])
    own = typesys.get_typestore(typesys.Stores.EMPTY)
    own.register(typesys.get_types_from_msg(definition, POINT_CLOUD))
    digest = own.generate_msgdef(POINT_CLOUD, ros_version=1)[1]
    with rosbag1.Writer(path) as bag:
        topic = bag.add_connection("/points", POINT_CLOUD, msgdef=definition, md5sum=digest)
        bag.write(topic, 10**9, bytes(1000))
    return path


def _with(lines: str, parts: str = "") -> Change:
    return lambda text: text.replace(_END, f"{_END}{lines}\n") + parts


@pytest.mark.parametrize(
    "change",
    [
        _with("string[100000000] names"),
        _with("a/B[200] all", f"{_PART}a/B\na/C[200] all\n{_PART}a/C\nuint8 one\n"),
        _with("a/B[] all", f"{_PART}a/B\n"),
        _with("a/B[] all", f"{_PART}a/B\na/C[9] all\n{_PART}a/C\n"),
        _with("sensor_msgs/PointCloud2 again"),
    ],
    ids=["many texts", "many in many", "a list of nothing", "a list of nines of nothing", "in itself"],
)
def test_a_message_of_too_many_values_is_refused_before_it_is_read(tmp_path: Path, change: Change) -> None:
    with pytest.raises(DataError, match=r"drive\.bag: .*: expected a message of at most 10,000 values"):
        whole_drive(_bag(tmp_path / "drive.bag", change), "bag")


def test_a_definition_of_megabytes_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = _bag(tmp_path / "drive.bag", _with(f"# {'a' * 300_000}"))
    with pytest.raises(DataError, match="expected definitions of messages of at most 262,144 characters"):
        whole_drive(path, "bag")


def test_metadata_of_megabytes_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", moving_lidar())
    with (tmp_path / "bag" / "metadata.yaml").open("a") as file:
        file.write("#" * 2_000_000)
    with pytest.raises(DataError, match=r"metadata\.yaml: cannot be read \(expected at most 1,048,576 bytes"):
        whole_drive(tmp_path / "bag", "bag")


@pytest.mark.parametrize("name", ["ROS1_NOETIC", "ROS2_HUMBLE", "LATEST"])
def test_messages_of_ros_are_possible_and_so_are_numbers_by_the_thousand(name: str) -> None:
    store = typesys.get_typestore(typesys.Stores[name])
    require_possible("bag", KINDS, store.fielddefs)
    require_possible("bag", store.fielddefs, store.fielddefs)
    numbers = typesys.get_types_from_msg("uint8[200000] one\nfloat32[] two\n", "a/msg/B")
    require_possible("bag", ["a/msg/B"], numbers)
