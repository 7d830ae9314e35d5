"""Types of a recipe's values with their bounds, which a specification checks when it is made."""

import operator
import sys
from dataclasses import dataclass, fields
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

from nvsf_core.errors import RecipeError

_LARGEST = sys.float_info.max
_COMPARE = {"<": operator.lt, "<=": operator.le}
_PLAIN = {
    int: "a whole number", float: "a finite number", bool: "a boolean", str: "a text", NoneType: "None"
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Within:
    """The interval in which a number must lie, of type `Annotated[int, Within(1, 64)]`."""

    least: float = -_LARGEST
    most: float = _LARGEST
    is_open: bool = False
    """Whether the least value itself is excluded."""

    def holds(self, value: float) -> bool:
        """Whether the number lies in it; NaN and infinity never do."""
        return self.least <= value <= self.most and not (self.is_open and value == self.least)

    def __str__(self) -> str:
        """In words, to follow those of a number's type."""
        if self.is_open:
            return f" above {self.least:g}" + ("" if self.most == _LARGEST else f" and at most {self.most:g}")
        if self.most == _LARGEST:
            return "" if self.least == -_LARGEST else f" of at least {self.least:g}"
        return f" from {self.least:g} to {self.most:.10g}"


Count = Annotated[int, Within(1)]
"""A whole number of at least 1."""
CountOrZero = Annotated[int, Within(0)]
"""A whole number of at least 0."""
Several = Annotated[int, Within(2)]
"""A whole number of at least 2."""
GridCount = Annotated[int, Within(1, 64)]
"""Levels of a hash grid, or features of an entry."""
Log2Table = Annotated[int, Within(1, 30)]
"""Base-2 logarithm of the entries of a hash grid's level."""
Resolution = Annotated[int, Within(2, 1 << 20)]
"""Grid points along an axis of a hash grid."""
Finite = Annotated[float, Within()]
"""Any number but NaN and infinity, as in all types below."""
NotNegative = Annotated[float, Within(0.0)]
"""A number of at least 0."""
Positive = Annotated[float, Within(0.0, is_open=True)]
"""A number above 0."""
Share = Annotated[float, Within(0.0, 1.0, is_open=True)]
"""A number above 0 and at most 1."""
ShareOrZero = Annotated[float, Within(0.0, 1.0)]
"""A number from 0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spec:
    """Base of a recipe's dataclasses: each field must have its type and lie in its bounds."""

    ORDER: ClassVar[tuple[str, str, str] | None] = None
    """Two fields and how they must compare, for example `("near_m", "<", "far_m")`; None = at will."""

    def __post_init__(self) -> None:
        """Check all fields.

        Raises:
            RecipeError: A value has another type, lies outside its bounds, or contradicts another.
        """
        name, kinds = type(self).__name__, get_type_hints(type(self), include_extras=True)
        for field in fields(self):
            kind, value = kinds[field.name], getattr(self, field.name)
            if not _fits(kind, value):
                raise RecipeError(f"{name}.{field.name}: expected {_words(kind)}, found {value!r:.60}")
        if self.ORDER is not None:
            low, sign, high = self.ORDER
            found = getattr(self, low), getattr(self, high)
            if not _COMPARE[sign](*found):
                raise RecipeError(f"{name}: expected {low} {sign} {high}, found {found[0]} and {found[1]}")


def _fits(kind: Any, value: Any) -> bool:
    """Whether a value is of a type: a class, `Annotated` with an interval, a union, a tuple or literals."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _fits(parts[0], value) and parts[1].holds(value)
    if origin in (Union, UnionType):
        return any(_fits(part, value) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is tuple:
        if not isinstance(value, tuple) or not value:
            return False
        kinds = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        return len(kinds) == len(value) and all(map(_fits, kinds, value))
    # To Python, True is a whole number, and a whole number no float.
    if kind in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, int | float if kind is float else kind)


def _words(kind: Any) -> str:
    """What a type is called in an error."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return f"{_words(parts[0])}{parts[1]}"
    if origin in (Union, UnionType):
        return " or ".join(_words(part) for part in parts)
    if origin is Literal:
        return "one of " + ", ".join(parts)
    if origin is tuple:
        many = "one or more values" if parts[-1] is Ellipsis else f"{len(parts)} values"
        return f"a tuple of {many}, each {_words(parts[0])}"
    return _PLAIN.get(kind, kind.__name__)
