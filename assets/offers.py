"""Checks over all scenes that start no run: is the trained recipe the one asked for, are data sets recent.

They are of no partition: each says of all scenes which ones it fails for, so that none hides another.
"""

import time
from collections.abc import Callable

import dagster as dg

from assets.scenes import key_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.runner.record import RECORD_NAME, made_s, read_record
from nvsf_core.stages.runner.trained import newest_field
from nvsf_core.stores.scene_store import SceneStore, published

RECIPE_CHECK, AGE_CHECK = "recipes_are_asked_for", "data_sets_are_of_this_week"
OLDEST_DAYS = 8.0
"""The weekly schedule makes a data set every seven days."""
_DAY_S = 86_400.0
_Fault = Callable[[SceneEntry, Workspace], str]


def recipe_fault(entry: SceneEntry, workspace: Workspace) -> str:
    """Why a scene's field is not what is asked for now; empty if it is, or if there is none."""
    store = SceneStore(workspace.home(), entry.name)
    newest = newest_field(store.root)
    if newest is None:
        return ""
    (recipe, seed), asked = newest, workspace.recipe_of(entry)
    record = read_record(store.path(f"field/{recipe}/{seed}")) or {}
    identity = record.get("facts", {}).get("recipe")
    if recipe == asked and identity in (None, preset(asked).identity()):
        return ""
    trained = "an earlier version of it" if recipe == asked else recipe
    return f"{asked} is asked for, trained was {trained}; launch `train_scene` on this scene to follow"


def age_fault(entry: SceneEntry, workspace: Workspace) -> str:
    """Why a scene's newest data set is too old; empty if it is not, or if there is none."""
    records = published(workspace.home() / entry.name, f"dataset/.index/*/*/{RECORD_NAME}")
    newest_s = max((made_s(path.parent) for path in records), default=None)
    if newest_s is None or time.time() - newest_s <= OLDEST_DAYS * _DAY_S:
        return ""
    return f"its newest data set is older than {OLDEST_DAYS:.0f} days; launch `regenerate_synthetic`"


OFFERS: dict[str, tuple[str, _Fault]] = {
    "field": (RECIPE_CHECK, recipe_fault),
    "dataset": (AGE_CHECK, age_fault),
}
"""Stage to the check of its asset, and what it asks of each scene."""
_DESCRIPTIONS = {
    "field": "Every scene has the recipe that is asked for. Another one is never forced: it is offered here.",
    "dataset": "Every scene's newest data set is at most eight days old.",
}


def offer_evaluation(stage: str, workspace: Workspace) -> dg.AssetCheckEvaluation:
    """The verdict on a stage of all scenes, as an event of no run."""
    name, fault_of = OFFERS[stage]
    found = {entry.name: fault_of(entry, workspace) for entry in catalogue()}
    faults = {scene: words for scene, words in found.items() if words}
    return dg.AssetCheckEvaluation(
        asset_key=key_of(stage),
        check_name=name,
        passed=not faults,
        severity=dg.AssetCheckSeverity.WARN,
        description=f"{len(faults)} of {len(found)} scenes: {', '.join(faults)}" if faults else "all scenes",
        metadata={scene: dg.MetadataValue.text(words) for scene, words in faults.items()},
    )


def _offer(stage: str) -> dg.AssetChecksDefinition:
    """A stage's check, also to be run by hand."""

    @dg.asset_check(asset=key_of(stage), name=OFFERS[stage][0], description=_DESCRIPTIONS[stage])
    def offer(workspace: Workspace) -> dg.AssetCheckResult:
        found = offer_evaluation(stage, workspace)
        return dg.AssetCheckResult(
            passed=found.passed,
            severity=found.severity,
            description=found.description,
            metadata=found.metadata,
        )

    return offer


offer_checks = [_offer(stage) for stage in OFFERS]
