"""Keys and partitions of the assets: one partition a scene whose drive is here."""

import warnings

import dagster as dg

# Said at every load and once for each check; what is used is named in docs/decisions/0026-automation.md.
warnings.filterwarnings("ignore", category=dg.BetaWarning)
warnings.filterwarnings("ignore", category=dg.PreviewWarning)

PREFIX = "nvsf"
OWNERS = ["team:nvsf"]
DATA_VERSION = "dagster/data_version"
"""Tag of an event that carries a data version."""
PARTITION_TAG = "dagster/partition"
"""Tag of a run of one scene."""
SCENES = dg.DynamicPartitionsDefinition(name="scenes")
"""Scenes whose drives were seen here: `new_drives` adds them, and so does every run of `train_all_scenes`."""


def key_of(name: str) -> dg.AssetKey:
    """Key of the asset of that name."""
    return dg.AssetKey([PREFIX, name])


def register(instance: dg.DagsterInstance, names: list[str]) -> None:
    """Add scenes to the instance's partitions; those that it has are left alone."""
    new = [name for name in names if not instance.has_dynamic_partition(SCENES.name or "", name)]
    if new:
        instance.add_dynamic_partitions(SCENES.name or "", new)
