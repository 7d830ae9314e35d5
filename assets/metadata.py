"""Metadata of an output for the UI: its place, its numbers and its pictures."""

import base64
import math
from collections.abc import Mapping
from pathlib import Path

import dagster as dg

from nvsf_core.stages import Outcome
from nvsf_core.stores.documents import read_picture

_PREVIEW_LIMIT_BYTES = 100_000
_DIGITS = 5


def outcome_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """Metadata of an output for the UI: path, seconds, its numbers and its preview pictures."""
    exports = exported_folders(outcome)
    metadata: dict[str, dg.MetadataValue] = {
        # The stage `dataset` publishes its data sets beside its own folder, which is an index.
        "path": dg.MetadataValue.path(str(next(iter(exports.values()), outcome.path))),
        "seconds": dg.MetadataValue.float(rounded(float(outcome.seconds))),
        "was_up_to_date": dg.MetadataValue.bool(outcome.skipped),
    }
    metadata |= scalar_metadata(outcome.resources)
    metadata |= {f"path_{view}": dg.MetadataValue.path(str(folder)) for view, folder in exports.items()}
    metadata |= scalar_metadata(outcome.metadata)
    for name, path in outcome.previews.items():
        metadata[f"preview_{name}"] = picture(path)
    return metadata


def exported_folders(outcome: Outcome) -> dict[str, Path]:
    """View to folder of the data sets that a stage published beside its own output and that are there."""
    if outcome.stage != "dataset":
        return {}
    root = next(folder for folder in outcome.path.parents if folder.name == outcome.stage)
    ending = "_version"
    folders = {
        key.removesuffix(ending): root / key.removesuffix(ending) / str(value)
        for key, value in outcome.metadata.items()
        if key.endswith(ending)
    }
    return {view: folder for view, folder in folders.items() if folder.is_dir()}


def rounded(value: float) -> float:
    """A number with as many digits as a person reads; whole numbers stay whole."""
    return round(value) if abs(value) >= 10**_DIGITS else float(f"{value:.{_DIGITS}g}")


def scalar_metadata(values: Mapping[str, float | int | str | bool]) -> dict[str, dg.MetadataValue]:
    """Convert plain values to Dagster's typed metadata values."""
    typed: dict[str, dg.MetadataValue] = {}
    for name, value in values.items():
        if isinstance(value, bool):
            typed[name] = dg.MetadataValue.bool(value)
        elif isinstance(value, int):
            typed[name] = dg.MetadataValue.int(value)
        elif isinstance(value, float):
            typed[name] = dg.MetadataValue.float(float(rounded(value)) if math.isfinite(value) else value)
        else:
            typed[name] = dg.MetadataValue.text(str(value))
    return typed


def picture(path: Path) -> dg.MetadataValue:
    """A PNG file as inline markdown. The event log stores it, so of a large file only the path is given."""
    content = read_picture(path)
    if content is None:
        return dg.MetadataValue.text(f"no picture at {path}")
    if len(content) > _PREVIEW_LIMIT_BYTES:
        return dg.MetadataValue.path(str(path))
    return dg.MetadataValue.md(f"![{path.stem}](data:image/png;base64,{base64.b64encode(content).decode()})")
