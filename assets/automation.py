"""When Dagster makes an asset by itself: what is missing, and what is made from something that changed.

What changed is known by data versions, which are digests of content: an output that was made again with the
same content starts nothing. A changed recipe or new code starts nothing either: see `assets.offers`.
"""

import dagster as dg

KEPT = "nvsf/choices"
"""Tag of a run that takes recipe and seed of the scene's newest field, not those that are asked for now."""
KEPT_TAGS = {KEPT: "kept"}
_SAMPLES = "nvsf/samples"
"""Tag of a run whose data sets are sampled with a seed of its own, if it names none."""
SAMPLES_TAGS = {_SAMPLES: "own"}
CATALOGUE_TAGS = {"nvsf/failed_for": "catalogue"}
"""Of a run that failed because the catalogue could not be read: no fault of the scene's."""

_Condition = dg.AutomationCondition


def _handled() -> dg.AutomationCondition:
    # Unlike Dagster's `since_last_handled`, what is missing at the very first evaluation counts as new.
    return _Condition.newly_requested() | _Condition.newly_updated()


def _sources_changed() -> dg.AutomationCondition:
    changed = _Condition.data_version_changed() | _Condition.will_be_requested()
    return _Condition.any_deps_match(changed).with_label("content of an input changed")


def follows_its_scene() -> dg.AutomationCondition:
    """Of a scene's output: make what is missing or whose inputs changed, once, when all inputs are there."""
    new = _Condition.missing().newly_true().with_label("newly missing")
    return (
        (new | _sources_changed()).since(_handled())
        & ~_Condition.any_deps_missing()
        & ~_Condition.any_deps_in_progress()
        & ~_Condition.in_progress()
    ).with_label("follows its scene")


def follows_all_scenes() -> dg.AutomationCondition:
    """Of the report: make it anew when any scene's metrics or data sets changed; others do not hinder."""
    return (
        _sources_changed().since(_handled()) & ~_Condition.any_deps_in_progress() & ~_Condition.in_progress()
    ).with_label("follows all scenes")


def seed_of_samples(run: dg.DagsterRun) -> int:
    """The run's own seed of ray drop and range noise, the same where it goes on as another run; 0 without.

    Args:
        run: The run; by its tags it samples with a seed of its own, or not.
    """
    return int((run.root_run_id or run.run_id)[:7], 16) if _SAMPLES in run.tags else 0
