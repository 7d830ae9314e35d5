"""Whether a variable of the environment switches something on."""

from collections.abc import Mapping

from nvsf_core.errors import RecipeError

AUTOMATE_VARIABLE = "NVSF_AUTOMATE"
"""Whether `scenes_follow` is on from the start."""
_ON, _OFF = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


def is_on(name: str, environ: Mapping[str, str]) -> bool:
    """Whether the variable `name` says yes, in upper or lower case; absent or empty is no.

    Raises:
        RecipeError: It is none of the words; a typing error must not start or stop trainings.
    """
    value = environ.get(name, "")
    word = value.strip().lower()
    if word not in ("", *_ON, *_OFF):
        raise RecipeError(
            f"{name}={value!r:.60}: expected {', '.join(_ON)}, or {', '.join(_OFF)}, or nothing"
        )
    return word in _ON
