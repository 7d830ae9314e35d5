"""Base of all recipes: a name, conversion to and from JSON, and an identity."""

import hashlib
import json
from dataclasses import asdict, dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, ClassVar, Self, get_args, get_origin, get_type_hints

from nvsf_core.errors import RecipeError
from nvsf_core.names import name_fault
from nvsf_core.recipe.bounds import Spec


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe(Spec):
    """All that decides what is trained and rendered, but the seed."""

    family: ClassVar[str] = ""
    """Name of the family whose code trains it."""

    name: str
    """Used as name of the output folders."""

    def __post_init__(self) -> None:
        """Refuse a name that cannot be a folder's, and wrong values.

        Raises:
            RecipeError: The name or a value is wrong.
        """
        fault = name_fault(self.name)
        if fault is not None:
            raise RecipeError(f"recipe: {fault}")
        Spec.__post_init__(self)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values, with the family."""
        return json.loads(json.dumps({"family": self.family} | asdict(self)))

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Read back what `to_json` gave.

        Raises:
            RecipeError: A field is unknown or missing, or its value is wrong.
        """
        if values.get("family") != cls.family:
            raise RecipeError(f"expected a recipe of the family {cls.family}, found {values.get('family')!r}")
        try:
            made: Self = _read(cls, {name: value for name, value in values.items() if name != "family"})
        except (TypeError, RecipeError) as error:
            raise RecipeError(f"this is no recipe of this version: {error}; train again") from error
        return made

    def identity(self) -> str:
        """SHA-256 of the sorted JSON, different for any two recipes that differ."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()


def _read(kind: Any, value: Any) -> Any:
    """Convert a JSON value to a type: a dataclass, a tuple, or a union of one and others; others stay."""
    if is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, dict):
            raise TypeError(f"expected the fields of {kind.__name__}, found {value!r}")
        hints = get_type_hints(kind)
        named = {field.name: hints[field.name] for field in fields(kind)}
        return kind(**{name: _read(named.get(name), part) for name, part in value.items()})
    if isinstance(value, list):
        return tuple(value)
    if get_origin(kind) is UnionType and isinstance(value, dict):
        # JSON does not name the dataclass, so a union may contain only one.
        return _read(next((option for option in get_args(kind) if is_dataclass(option)), None), value)
    return value
