"""Checks that need no run: what is offered but never forced, and what has grown old."""

import time
from typing import Any

import dagster as dg

from assets.scenes import SCENES, key_of
from assets.workspace import Workspace
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.recipe import preset
from nvsf_core.stages.runner.record import RECORD_NAME, read_record
from nvsf_core.stages.runner.trained import newest_field
from nvsf_core.stores.scene_store import SceneStore, published

RECIPE_CHECK, AGE_CHECK = "recipe_is_asked_for", "made_within_a_week"
OFFERS = {
    "field": (RECIPE_CHECK, "The field has the recipe that is asked for now. Another one is never forced: "
              "launch `train_scene` on the partition to follow."),
    "dataset": (AGE_CHECK, "The scene's newest data set is at most eight days old, as the weekly schedule "
                "promises."),
}  # fmt: skip
"""Stage to the check of its asset and the check's description."""
OLDEST_DAYS = 8.0
_DAY_S = 86_400.0


def offer_specs(stage: str) -> list[dg.AssetCheckSpec]:
    """The specs of a stage's checks."""
    named = OFFERS.get(stage)
    if named is None:
        return []
    return [dg.AssetCheckSpec(named[0], asset=key_of(stage), description=named[1], partitions_def=SCENES)]


def offer_verdicts(stage: str, entry: SceneEntry, workspace: Workspace) -> list[dict[str, Any]]:
    """Keyword arguments of an `AssetCheckResult` (or evaluation) per check; none if nothing is published."""
    if stage not in OFFERS:
        return []
    found = _recipe(entry, workspace) if stage == "field" else _age(entry, workspace)
    if found is None:
        return []
    passed, words = found
    return [
        {
            "check_name": OFFERS[stage][0],
            "passed": passed,
            "severity": dg.AssetCheckSeverity.WARN,
            "description": f"scene {entry.name}: {words}",
        }
    ]


def _recipe(entry: SceneEntry, workspace: Workspace) -> tuple[bool, str] | None:
    store = SceneStore(workspace.home(), entry.name)
    newest = newest_field(store.root)
    if newest is None:
        return None
    (recipe, seed), asked = newest, workspace.recipe_of(entry)
    record = read_record(store.path(f"field/{recipe}/{seed}")) or {}
    identity = record.get("facts", {}).get("recipe")
    if recipe == asked and identity in (None, preset(asked).identity()):
        return True, f"trained with {recipe}, which is asked for"
    words = "an earlier version of it" if recipe == asked else recipe
    return False, f"{asked} is asked for, trained was {words}; launch train_scene on it to follow"


def _age(entry: SceneEntry, workspace: Workspace) -> tuple[bool, str] | None:
    records = published(workspace.home() / entry.name, f"dataset/.index/*/*/{RECORD_NAME}")
    if not records:
        return None
    days = (time.time() - max(path.stat().st_mtime for path in records)) / _DAY_S
    return days <= OLDEST_DAYS, f"newest data set {'at most' if days <= OLDEST_DAYS else 'more than'} " + (
        f"{OLDEST_DAYS:.0f} days old"
    )
