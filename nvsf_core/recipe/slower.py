"""A recipe with smaller steps, for where it diverged: `lean@0.5` takes half of the step sizes of `lean`."""

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from nvsf_core.errors import RecipeError
from nvsf_core.recipe.base import Recipe

__all__ = ["differ_in_step_size", "full_name", "share_of", "slower"]

_MARK = "@"
_LEAST_SHARE = 1e-6
_RATES = ("rate", "table_rate", "network_rate", "head_rate", "flow_rate")
_Kind = TypeVar("_Kind", bound=Recipe)


def slower(recipe: _Kind, share: float) -> _Kind:
    """The recipe with all its optimisers' step sizes times `share`, under a name that says so.

    Raises:
        RecipeError: The share is not above 0 and at most 1.
    """
    if not _LEAST_SHARE <= share <= 1.0:
        raise RecipeError(
            f"recipe {recipe.name}: expected a share of its rates from {_LEAST_SHARE:g} to 1, found {share}"
        )
    slowed: _Kind = replace(_scaled(recipe, share), name=f"{full_name(recipe.name)}{_MARK}{share:g}")
    return slowed


def full_name(name: str) -> str:
    """Name of the recipe whose step sizes this one has a share of: itself where there is no share."""
    return name.partition(_MARK)[0]


def share_of(name: str) -> float:
    """The share of step sizes that a recipe's name asks for; 1 where it names none.

    Raises:
        RecipeError: What follows the mark is no number.
    """
    _, mark, share = name.partition(_MARK)
    try:
        return float(share) if mark else 1.0
    except ValueError:
        raise RecipeError(f"recipe {name!r}: expected a number after {_MARK}, found {share!r}") from None


def differ_in_step_size(one: Recipe, other: Recipe) -> bool:
    """Whether two recipes differ, and in nothing but their step sizes and names."""
    same, also = (replace(_scaled(recipe, 0.0), name="same") for recipe in (one, other))
    return one != other and type(one) is type(other) and bool(same == also)


def _scaled(spec: Any, share: float) -> Any:
    changed: dict[str, Any] = {}
    for field in fields(spec):
        value = getattr(spec, field.name)
        if is_dataclass(value):
            changed[field.name] = _scaled(value, share)
        elif field.name in _RATES:
            changed[field.name] = value * share
    return replace(spec, **changed) if changed else spec
