"""What an output that an op reports was made of, in the tags by which the UI marks what is out of date.

Dagster sets them in runs of assets alone. Without them it compares times: it marks what reads an output that
was reported again with the same content, and neither new code nor a changed drive.
"""

from collections.abc import Iterable

import dagster as dg

# Not exported by Dagster; it is held below 1.14.
from dagster._core.definitions.data_version import (
    CODE_VERSION_TAG,
    DEFAULT_DATA_VERSION,
    NULL_EVENT_POINTER,
    get_input_data_version_tag,
    get_input_event_pointer_tag,
)

from assets.scenes import DATA_VERSION


def made_of(
    instance: dg.DagsterInstance, code_version: str, inputs: Iterable[dg.AssetKey], scene: str | None = None
) -> dict[str, str]:
    """Tags of an output's event; to be asked for before the inputs are read.

    Args:
        instance: Has the events of the inputs.
        code_version: Of what makes the output.
        inputs: Assets that it is made of, outputs or observed ones.
        scene: The partition of output and inputs; none if the output is made of all of them.
    """
    tags = {CODE_VERSION_TAG: code_version}
    for key in inputs:
        newest = newest_version(instance, key, scene)
        version = newest.event_log_entry.tags.get(DATA_VERSION) if newest else None
        tags[get_input_data_version_tag(key)] = version or DEFAULT_DATA_VERSION.value
        tags[get_input_event_pointer_tag(key)] = str(newest.storage_id) if newest else NULL_EVENT_POINTER
    return tags


def newest_version(
    instance: dg.DagsterInstance, key: dg.AssetKey, scene: str | None
) -> dg.EventLogRecord | None:
    """The newest event that has the version of an output or an observed asset; None if there is none."""
    asked = dg.AssetRecordsFilter(asset_key=key, asset_partitions=None if scene is None else [scene])
    for fetch in (instance.fetch_materializations, instance.fetch_observations):
        for record in fetch(asked, limit=1).records:
            return record
    return None
