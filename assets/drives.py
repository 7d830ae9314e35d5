"""Drives: what the project reads and does not make, observed by content."""

import time
from collections.abc import Callable, Iterable

import dagster as dg

from assets.provenance import newest_version
from assets.scenes import DATA_VERSION, SCENES, key_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import NvsfError
from nvsf_core.stages.runner.contents import hashes_of
from nvsf_core.stages.runner.facts import drive_version, views_version
from nvsf_core.stores.file_hashes import FileHashes
from nvsf_core.stores.scene_store import SceneStore

DRIVE, ASKED_VIEWS = "drive", "asked_views"
VERSIONS: dict[str, Callable[[SceneEntry, FileHashes], str]] = {
    DRIVE: drive_version,
    ASKED_VIEWS: views_version,
}
"""Data version of each observed asset of a scene."""
_DESCRIPTIONS = {
    DRIVE: "The recorded drive: every file that the scene reads, by content, and its entry in the catalogue.",
    ASKED_VIEWS: "The views that the catalogue asks for, and the content of their true images.",
}
_KINDS = {DRIVE: {"file"}, ASKED_VIEWS: {"toml"}}


def versions_of(
    entry: SceneEntry, workspace: Workspace, most_s: float = float("inf"), names: Iterable[str] = VERSIONS
) -> dict[str, str]:
    """Data version of observed assets of a scene; files are read only where they changed.

    Args:
        entry: The scene.
        workspace: Names the home, where hashes are remembered.
        most_s: Seconds after which no further file is read.
        names: The assets; default all.

    Raises:
        DataError: A file cannot be read.
        TimeIsUpError: The time is up; what was read is remembered, so that the next call goes on from there.
    """
    store = SceneStore(workspace.home(), entry.name)
    with hashes_of(store, until_s=time.monotonic() + most_s) as hashes:
        return {name: VERSIONS[name](entry, hashes) for name in names}


def observation(name: str, entry: SceneEntry, version: str) -> dg.AssetObservation:
    """Event that reports the data version of an observed asset of a scene."""
    return dg.AssetObservation(
        asset_key=key_of(name),
        partition=entry.name,
        metadata={"path": dg.MetadataValue.path(str(entry.root))},
        tags={DATA_VERSION: version},
    )


def newly_seen(
    instance: dg.DagsterInstance, entry: SceneEntry, workspace: Workspace, names: Iterable[str]
) -> list[dg.AssetObservation]:
    """Events of observed assets that differ from what was reported of them last.

    A run that is about to read them reports it: else what it makes would be marked as out of date, or never,
    once the sensor sees them. Nothing is said of what cannot be read, for the stage that reads it does.

    Args:
        instance: Has the events of before.
        entry: The scene.
        workspace: As of `versions_of`.
        names: The assets.
    """
    try:
        found = versions_of(entry, workspace, names=names)
    except (NvsfError, OSError):
        return []
    before = {name: newest_version(instance, key_of(name), entry.name) for name in found}
    return [
        observation(name, entry, version)
        for name, version in found.items()
        if (event := before[name]) is None or event.event_log_entry.tags.get(DATA_VERSION) != version
    ]


def _observed(name: str) -> dg.AssetsDefinition | dg.SourceAsset:
    """An asset that is observed, by the UI's button or the sensor `new_drives`, and never made."""

    @dg.observable_source_asset(
        key=key_of(name),
        partitions_def=SCENES,
        group_name="drives",
        description=_DESCRIPTIONS[name],
        tags={f"dagster/kind/{kind}": "" for kind in _KINDS[name]},
    )
    def observe(context: dg.OpExecutionContext, workspace: Workspace) -> dg.DataVersionsByPartition:
        known = set(context.instance.get_dynamic_partitions(SCENES.name or ""))
        entries = [entry for entry in catalogue() if entry.name in known]
        found: dict[str, str] = {}
        for entry in entries:
            try:
                found[entry.name] = versions_of(entry, workspace, names=[name])[name]
            except (NvsfError, OSError) as error:
                # One scene's files must not hide the others' changes.
                context.log.warning(f"[{entry.name}] not observed: {error}")
        return dg.DataVersionsByPartition(found)

    return observe


drive_assets = [_observed(name) for name in VERSIONS]
