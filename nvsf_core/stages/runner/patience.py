"""Waiting for a catalogue that somebody is editing."""

import time
from collections.abc import Callable
from typing import TypeVar

from nvsf_core.errors import CatalogueError
from nvsf_core.stages.runner.stage import Progress

PATIENCE_S = 60.0
"""For which a step that has begun reads a broken catalogue again: a half-typed line should not end a run."""
_EVERY_S = 1.0
_Read = TypeVar("_Read")


def patiently(read: Callable[[], _Read], progress: Progress) -> _Read:
    """What `read` returns; while the catalogue cannot be read it is called again, for `PATIENCE_S`.

    Args:
        read: Reads the catalogue.
        progress: Receives one line if it waits.

    Raises:
        CatalogueError: The catalogue still cannot be read.
    """
    until_s, is_said = time.monotonic() + PATIENCE_S, False
    while True:
        try:
            return read()
        except CatalogueError as error:
            if time.monotonic() >= until_s:
                raise
            if not is_said:
                progress(f"waits up to {PATIENCE_S:.0f} s until the catalogue can be read: {error}")
                is_said = True
        time.sleep(_EVERY_S)
