"""Bounds on what a bag's own definitions of its messages may ask for.

The package rosbags writes, compiles and runs a reader for each kind of message, with lines for each element
of an array of fixed length: a definition of some bytes may ask for more lines than a machine has memory, or
for messages in messages without end.
"""

import importlib
from collections.abc import Callable, Collection, Mapping
from typing import Any

from nvsf_core.drives.kitti360.text import MIB
from nvsf_core.errors import DataError

_MOST_CHARACTERS, _MOST_CHARACTERS_IN_ALL = MIB // 4, 2 * MIB
"""Of a definition with all that it refers to, and of a bag's different ones. ROS's own have up to 4,000."""
_MOST_VALUES = 10_000
"""Of a message beside its lists and numeric arrays; those that are read have up to some 40."""

_NO_BYTES = "structure_needs_at_least_one_member"
"""The one field of messages without any, which ROS 1 does not write."""


def bound_definitions() -> None:
    """Have rosbags parse, of the bag that is opened next, no more than is possible: a megabyte takes minutes.

    Raises:
        ImportError: The package rosbags is not installed.
    """
    reader: Any = importlib.import_module("rosbags.highlevel.anyreader")
    typesys = importlib.import_module("rosbags.typesys")
    reader.get_types_from_msg = _bounded(typesys.get_types_from_msg)
    reader.get_types_from_idl = _bounded(typesys.get_types_from_idl)


def _bounded(parse: Callable[..., Any]) -> Callable[..., Any]:
    """The parser, for texts up to a size; each is parsed once, as many topics are of one kind."""
    known: dict[tuple[str, ...], Any] = {}

    def parsed(*definition: str) -> Any:
        if definition not in known:
            in_all = sum(len(one[0]) for one in (*known, definition))
            if len(definition[0]) > _MOST_CHARACTERS or in_all > _MOST_CHARACTERS_IN_ALL:
                raise DataError(
                    f"expected definitions of messages of at most {_MOST_CHARACTERS:,} characters, "
                    f"{_MOST_CHARACTERS_IN_ALL:,} in all, found one of {len(definition[0]):,}, {in_all:,} in "
                    "all; write the bag again, with the topics alone that are to be read"
                )
            known[definition] = parse(*definition)
        return known[definition]

    return parsed


def require_possible(where: str, kinds: Collection[str], definitions: Mapping[str, Any]) -> None:
    """Refuse messages that no reader is to be made for.

    Args:
        where: The bag, for messages.
        kinds: Of the messages that are read.
        definitions: Kind to what rosbags has parsed.

    Raises:
        DataError: Such a message is of too many values, of itself, or of many that take no bytes.
    """
    known: dict[str, int] = {}
    for kind in kinds:
        _values(where, kind, definitions, known)


def _values(where: str, kind: str, definitions: Mapping[str, Any], known: dict[str, int]) -> int:
    """How many values a message of a kind has at least; 0 = it takes no bytes."""
    if kind in known:
        return known[kind]
    known[kind] = _MOST_VALUES + 1  # where it comes again in itself
    values = 0
    for name, (node, of) in definitions.get(kind, ((), ()))[1]:
        is_list, is_array = node.name == "SEQUENCE", node.name == "ARRAY"
        (part, part_of), count = of if is_list or is_array else ((node, of), 1)
        each = _values(where, part_of, definitions, known) if part.name == "NAME" else int(name != _NO_BYTES)
        if is_list or (part.name == "BASE" and part_of[0] != "string"):
            count = 1  # a list has its length, and numbers are read at once
        values += count * each
        if values > _MOST_VALUES or ((is_list or is_array) and each == 0):
            raise DataError(
                f"{where}: {kind}: {name}: expected a message of at most {_MOST_VALUES:,} values beside its "
                "lists, each of some bytes, found another definition; write the bag again by that of ROS"
            )
    known[kind] = values
    return values
