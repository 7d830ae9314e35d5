"""What all recipes have in common: a name, JSON in and out, and an identity."""

import hashlib
import json
from dataclasses import asdict, dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, ClassVar, Self, get_args, get_origin, get_type_hints

from nvsf_core.errors import RecipeError
from nvsf_core.names import name_fault


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """All that decides what is trained and rendered, but the seed."""

    family: ClassVar[str] = ""
    """Which code trains it."""

    name: str
    """Names the output folders."""

    def __post_init__(self) -> None:
        """Refuse a name that is no folder's."""
        fault = name_fault(self.name)
        if fault is not None:
            raise RecipeError(f"recipe: {fault}")

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values, with the family."""
        values: dict[str, Any] = json.loads(json.dumps({"family": self.family} | asdict(self)))
        return values

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Read back what `to_json` gave.

        Raises:
            RecipeError: A field is unknown or missing.
        """
        if values.get("family") != cls.family:
            raise RecipeError(f"expected a recipe of the family {cls.family}, found {values.get('family')!r}")
        try:
            made: Self = _read(cls, {name: value for name, value in values.items() if name != "family"})
        except TypeError as error:
            raise RecipeError(f"this is no recipe of this version: {error}") from error
        return made

    def identity(self) -> str:
        """SHA-256 of the sorted JSON: two recipes that differ anywhere differ here."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()


_PLAIN: dict[Any, Any] = {bool: bool, int: int, float: (int, float), str: str}
"""Kinds of single values, and what of JSON is one: a whole number is a float, too."""


def _read(kind: Any, value: Any) -> Any:
    """A value of a dataclass, a tuple, or one of several kinds, from JSON."""
    if is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, dict):
            raise TypeError(f"expected the fields of {kind.__name__}, found {value!r}")
        hints = get_type_hints(kind)
        named = {field.name: hints[field.name] for field in fields(kind)}
        return kind(**{name: _read(named.get(name), part) for name, part in value.items()})
    if kind in _PLAIN and (
        isinstance(value, bool) is not (kind is bool) or not isinstance(value, _PLAIN[kind])
    ):
        raise TypeError(f"expected a {kind.__name__}, found {value!r:.60}")
    if isinstance(value, list):
        return tuple(value)
    if get_origin(kind) is UnionType and isinstance(value, dict):
        # Which of several dataclasses was meant is not written down: only one may be among the kinds.
        return _read(next((option for option in get_args(kind) if is_dataclass(option)), None), value)
    return value
