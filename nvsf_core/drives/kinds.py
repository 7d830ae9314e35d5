"""Tests of the kinds of values in catalogue entries: a dataclass does not check its annotations."""

from collections.abc import Callable, Mapping
from pathlib import Path

from nvsf_core.errors import DataError
from nvsf_core.names import name_fault

MOST_FRAMES = 20_000
"""Most frames of one scene, and instants of one view: half an hour. KITTI-360's longest drive has 15,000."""
_LONGEST_LINE = 200
LONGEST_PATH = 2000
"""Characters of a path."""
_LARGEST = 1e15
"""Largest number in a catalogue."""

IsKind = Callable[[object], bool]
Kinds = Mapping[str, tuple[IsKind, str]]
"""Field to a test of its value, and what it expects, in words."""


def is_whole(value: object) -> bool:
    """Whether a value is a whole number; a bool is none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Whether a value is a finite number of possible size; a bool is none."""
    # NaN and infinity compare false, too.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def is_text(value: object) -> bool:
    """Whether a value is a text that is not empty."""
    return isinstance(value, str) and bool(value)


def is_bool(value: object) -> bool:
    """Whether a value is true or false."""
    return isinstance(value, bool)


def is_line(value: object) -> bool:
    """Whether a value is a text of one line and at most 200 characters."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST_LINE and value.isprintable()


def is_path(value: object) -> bool:
    """Whether a value is a path that a disk can have."""
    return isinstance(value, Path) and "\0" not in str(value) and len(str(value)) <= LONGEST_PATH


def each(is_one: IsKind, fewest: int = 1, most: int = MOST_FRAMES) -> IsKind:
    """A test whether a value is a tuple of `fewest` to `most` items that pass `is_one`."""
    return lambda value: isinstance(value, tuple) and fewest <= len(value) <= most and all(map(is_one, value))


def or_none(is_one: IsKind) -> IsKind:
    """A test whether a value is None or passes `is_one`."""
    return lambda value: value is None or is_one(value)


def require_kinds(entry: object, kinds: Kinds) -> None:
    """Refuse fields of other kinds.

    Raises:
        DataError: There is one; the message names it, what is expected and what was found.
    """
    for name, (is_kind, words) in kinds.items():
        value = getattr(entry, name)
        if not is_kind(value):
            raise DataError(f"{name}: expected {words}, found {value!r:.60}")


def require_name(what: str, name: str, reserved: tuple[str, ...] = ()) -> None:
    """Refuse a name that cannot be a folder's.

    Raises:
        DataError: It cannot; the message says why.
    """
    fault = name_fault(name, reserved)
    if fault is not None:
        raise DataError(f"{what}: {fault}")


def require_range(what: str, value: float, least: float, most: float, unit: str) -> None:
    """Refuse a number outside of `least` to `most`.

    Args:
        what: Name of the key.
        value: The number.
        least: Allowed.
        most: Allowed.
        unit: In words, for the message.

    Raises:
        DataError: It is outside.
    """
    if not least <= value <= most:
        raise DataError(f"{what}: expected {least:g} to {most:g} {unit}, found {value:g}")
