"""`new_drives`: a sensor that watches the catalogue and its roots; `scenes_follow` makes what they change."""

import json
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

import dagster as dg

from assets.automation import KEPT_TAGS
from assets.drives import observation, versions_of
from assets.offers import OFFERS, offer_evaluation
from assets.scenes import PARTITION_TAG, SCENES, key_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.section import why_wait
from nvsf_core.errors import NvsfError
from nvsf_core.stores.file_hashes import TimeIsUpError
from pipelines.jobs import RETRY_TAGS, UNFINISHED
from pipelines.switch import AUTOMATE_VARIABLE, is_on, quiet_s

_MOST_READING_S = 20.0
"""Of one scene in one tick; Dagster ends a tick after 60 s. The next tick goes on from there."""

_OFFERS = "/offers"
"""Key of the cursor for the verdicts on all scenes; no scene can have that name."""

_Seen = dict[str, dict[str, Any]]
"""Scene to what was last reported of it: data versions of its drive and views."""


class _Found(NamedTuple):
    """What a tick found of one scene."""

    seen: dict[str, Any]
    events: list[dg.AssetObservation]


@dg.sensor(
    minimum_interval_seconds=30,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Watches the catalogue and its roots: a scene whose drive is whole becomes a partition, a "
    "changed drive or view is reported by the content of its files. Half-copied drives wait. A scene that is "
    "in the catalogue no more is no partition, and its waiting run is canceled; what was made of it stays. "
    "Starts no run.",
)
def new_drives(context: dg.SensorEvaluationContext) -> dg.SensorResult:
    """Report drives that are new or changed.

    Raises:
        NvsfError: The catalogue or NVSF_QUIET_S cannot be read; the tick fails, for nothing is watched.
    """
    seen, words, new = _load(context.cursor), list[str](), list[str]()
    events: list[dg.AssetObservation | dg.AssetCheckEvaluation] = []
    known = set(context.instance.get_dynamic_partitions(SCENES.name or ""))
    entries, workspace, waits_s = catalogue(), Workspace(), quiet_s(os.environ)
    absent = sorted(known - {entry.name for entry in entries})
    busy = [name for name in absent if _is_at_work(context.instance, name)]
    gone = [name for name in absent if name not in busy]
    seen = {name: one for name, one in seen.items() if name not in gone}
    for entry in entries:
        try:
            section = drive_of(entry).section()
            if not section.folders:
                continue
            waits = why_wait(section, waits_s)
            if waits:
                words.append(f"{entry.name} waits: {waits}")
                continue
            found = _look_at(entry, workspace, seen.get(entry.name, {}))
        except TimeIsUpError:
            words.append(f"{entry.name}: its files are still being read")
            continue
        except (NvsfError, OSError) as error:
            words.append(f"{entry.name}: {error}")
            continue
        new += [entry.name] if entry.name not in known else []
        seen[entry.name] = found.seen
        events += found.events
    try:
        events += _changed_offers(context.instance, workspace, seen)
    except (NvsfError, OSError) as error:
        words.append(f"offers: {error}")
    words += [f"{name}: in the catalogue no more, so no partition; its outputs stay" for name in gone]
    words += [f"{name}: in the catalogue no more; its run is at work" for name in busy]
    if words:
        context.log.info("; ".join(words))  # also where something else is reported, which leaves no reason
    requests = [SCENES.build_add_request(new)] if new else []
    return dg.SensorResult(
        skip_reason=None if events or new or gone else dg.SkipReason("; ".join(words) or "nothing new"),
        dynamic_partitions_requests=[*requests, *([SCENES.build_delete_request(gone)] if gone else [])],
        asset_events=events,
        cursor=json.dumps(seen),
    )


def _is_at_work(instance: dg.DagsterInstance, scene: str) -> bool:
    """Whether a run of a scene that left the catalogue is at work; one that waits is canceled.

    Without its partition either would fail in Dagster, whose words name no catalogue.
    """
    of_scene = dg.RunsFilter(tags={PARTITION_TAG: scene}, statuses=UNFINISHED)
    runs = instance.get_runs(of_scene)
    for run in runs:
        if run.status is dg.DagsterRunStatus.QUEUED:
            instance.report_run_canceling(run, f"{scene} is in the catalogue no more")
            instance.report_run_canceled(run)
    return any(run.status is not dg.DagsterRunStatus.QUEUED for run in runs)


def _look_at(entry: SceneEntry, workspace: Workspace, before: dict[str, Any]) -> _Found:
    """Data versions of a scene's sources, and the events of those that changed."""
    events: list[dg.AssetObservation] = []
    now: dict[str, Any] = {}
    for name, version in versions_of(entry, workspace, _MOST_READING_S).items():
        now[name] = version
        if before.get(name) != version:
            events.append(observation(name, entry, version))
    return _Found(now, events)


def _changed_offers(
    instance: dg.DagsterInstance, workspace: Workspace, seen: _Seen
) -> Iterator[dg.AssetCheckEvaluation]:
    """Verdicts on all scenes, where they or the asset have changed since they were reported last.

    The UI forgets a verdict once the asset is made again, so it is reported anew.
    """
    before = seen.setdefault(_OFFERS, {})
    for stage in OFFERS:
        newest = instance.get_latest_materialization_event(key_of(stage))
        if newest is None:
            continue
        found = offer_evaluation(stage, workspace)
        words = [newest.timestamp, {scene: value.value for scene, value in found.metadata.items()}]
        if before.get(stage) != words:
            before[stage] = words
            yield found


def _load(cursor: str | None) -> _Seen:
    try:
        found = json.loads(cursor or "{}")
    except ValueError:
        return {}
    return (
        {name: one for name, one in found.items() if isinstance(one, dict)} if isinstance(found, dict) else {}
    )


_FOLLOWS = is_on(AUTOMATE_VARIABLE, os.environ)

scenes_follow = dg.AutomationConditionSensorDefinition(
    "scenes_follow",
    target=dg.AssetSelection.all(),
    minimum_interval_seconds=30,
    default_status=dg.DefaultSensorStatus.RUNNING if _FOLLOWS else dg.DefaultSensorStatus.STOPPED,
    run_tags={**KEPT_TAGS, **RETRY_TAGS},
    emit_backfills=False,
    description="Ingests, trains, renders, measures and writes what is new, and what a changed drive or view "
    "changes, one scene a run; a trained scene keeps its recipe and seed. Off unless NVSF_AUTOMATE=1 is set "
    "or it is switched on here.",
)
