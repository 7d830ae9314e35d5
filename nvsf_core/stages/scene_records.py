"""The stages' records of one scene, as the report shows them."""

from collections.abc import Mapping
from pathlib import Path

from nvsf_core._types import Scalar
from nvsf_core.reporting.stage_record import StageRecord
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stages.runner.record import RECORD_NAME, content_of, made_s, read_record
from nvsf_core.stages.versions import VERSIONS
from nvsf_core.stores.scene_store import published

_INDEX = ".index"
RECORDS = (f"*/{RECORD_NAME}", f"*/*/*/{RECORD_NAME}", f"dataset/{_INDEX}/*/*/{RECORD_NAME}")
"""Patterns of stage records below a scene's folder: once per scene, per recipe and seed, per data set."""


def stage_records(root: Path) -> list[StageRecord]:
    """The stages' records in the order of the flow; of data sets only the newest of each recipe and seed."""
    found: dict[str, tuple[float, Path]] = {}
    for pattern in RECORDS:
        for path in published(root, pattern):
            name = _name_of(path.parent.relative_to(root).parts)
            made = made_s(path.parent)
            if name not in found or found[name][0] < made:
                found[name] = (made, path.parent)
    records = []
    for name in sorted(found, key=_flow_rank):
        record = read_record(found[name][1])
        if record is not None:
            shown = {key: record[key] for key in ("seconds", "metadata", "checks", "facts", "made_s")}
            shown["metadata"] = _without_removed(root, name, record["metadata"])
            records.append(StageRecord(stage=name, content=content_of(record), **shown))
    return records


def _name_of(parts: tuple[str, ...]) -> str:
    """A record's stage and, of one that is run per recipe, recipe and seed; by the parts of its place."""
    if parts[1:2] == (_INDEX,):
        stage, _, recipe, sampled = parts  # seed, seed of drawing and label
        return f"{stage} {recipe} {sampled.partition('-')[0]}"
    return " ".join(parts)


def _without_removed(root: Path, name: str, metadata: Mapping[str, Scalar]) -> dict[str, Scalar]:
    """A record's numbers; of data sets without the versions that were removed, to which no link leads."""
    ending = "_version"
    return {
        key: value
        for key, value in metadata.items()
        if not (name.startswith(VERSIONS) and key.endswith(ending))
        or (root / VERSIONS / key.removesuffix(ending) / str(value)).is_dir()
    }


def _flow_rank(name: str) -> tuple[int, str]:
    stage = name.split(" ")[0]
    return (STAGE_NAMES.index(stage) if stage in STAGE_NAMES else len(STAGE_NAMES), name)
