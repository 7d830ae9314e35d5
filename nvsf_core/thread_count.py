"""How many CPU threads this process uses."""

import os

from nvsf_core.errors import RecipeError

VARIABLE = "NVSF_THREADS"


def thread_count() -> int:
    """CPU threads that this process uses: NVSF_THREADS, or all cores that it may run on.

    Raises:
        RecipeError: NVSF_THREADS is not a whole number from 1 on.
    """
    wanted = os.environ.get(VARIABLE, "")
    if not wanted:
        return len(os.sched_getaffinity(0))
    if not wanted.isdecimal() or int(wanted) < 1:
        raise RecipeError(
            f"{VARIABLE}={wanted!r}: expected a whole number of threads, 1 or more; correct or unset it"
        )
    return int(wanted)
