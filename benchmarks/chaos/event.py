"""What an event is, and what came of one."""

import random
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.chaos.world import World

Random = random.Random


@dataclass(frozen=True, slots=True)
class Harm:
    """What was done, and what was said of it."""

    how: str
    said: str = ""
    """All that the harmed commands said."""
    expected: str = ""
    """Regular expression that must be found in it; empty if a killed command cannot say anything."""


@dataclass(frozen=True, slots=True)
class Event:
    """One kind of harm."""

    name: str
    what: str
    """In a few words, for the table."""
    harm: Callable[[World, Random], Harm]
    needs_disk: bool = False
    """Whether the home must lie on a disk of its own."""
    needs_dagster: bool = False
    """Whether it is about Dagster's processes."""
    weight: int = 2
    """How often it comes, beside the others."""
