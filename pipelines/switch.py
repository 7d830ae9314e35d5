"""What variables of the environment say of what runs by itself: whether, and how long it waits."""

import math
from collections.abc import Mapping

from nvsf_core.errors import RecipeError

AUTOMATE_VARIABLE = "NVSF_AUTOMATE"
"""Whether `scenes_follow` is on from the start."""
QUIET_VARIABLE = "NVSF_QUIET_S"
"""Seconds without a change after which a drive is whole."""
_QUIET_S = 60.0
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


def quiet_s(environ: Mapping[str, str]) -> float:
    """How many seconds nothing of a drive must have changed for it to be whole: `QUIET_VARIABLE`, else 60.

    Raises:
        RecipeError: It is no number from 0 on.
    """
    value = environ.get(QUIET_VARIABLE) or str(_QUIET_S)
    try:
        found = float(value)
    except ValueError:
        found = math.nan
    if not 0.0 <= found < math.inf:
        raise RecipeError(f"{QUIET_VARIABLE}={value!r:.60}: expected seconds, 0 or more; correct or unset it")
    return found
