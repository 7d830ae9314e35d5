"""What a stage said of its own run, as the report reads it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRecord:
    """A stage's record of its own run."""

    stage: str
    """Name of the stage, followed by recipe and seed for stages that are run per recipe."""
    seconds: float
    metadata: dict[str, Any]
    checks: list[dict[str, Any]]
    """Each with `name`, `passed`, `detail` and, if it has them, `value`, `limit`, `unit`."""
    facts: Mapping[str, Any]
    """All that decided its output, by `stages.runner.facts.facts_of`."""
    made_s: float
    """When its output was made, seconds since the epoch."""
    content: str
    """Digest of its output's files, by which `facts` of its readers name it."""

    @property
    def inputs(self) -> Mapping[str, str]:
        """Stage to the content of its output, of those that this run read; empty if unknown."""
        found = self.facts.get("inputs")
        return found if isinstance(found, dict) else {}


def record_of(records: Sequence[StageRecord], stage: str, recipe: str, seed: str) -> StageRecord | None:
    """The record of a stage that is run per recipe and seed; None if there is none."""
    return next((one for one in records if one.stage == f"{stage} {recipe} {seed}"), None)
