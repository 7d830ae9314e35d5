"""The manifest of a data set: sealed, so that a version says by itself whether it is as it was published."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nvsf_core.errors import StoreError
from nvsf_core.stores.checksums import damaged_file, json_digest
from nvsf_core.stores.documents import read_document

MANIFEST_NAME = "manifest.json"
SEAL = "manifest_sha256"
"""Key of the manifest: SHA-256 of all its other entries."""

CHECKSUMS = "checksums"
"""Key of the manifest: size and checksum of each other file."""


def write_manifest(folder: Path, entries: Mapping[str, Any]) -> None:
    """Write the manifest, as strict JSON, with the digest of its entries."""
    sealed = {**entries, SEAL: json_digest(entries)}
    (folder / MANIFEST_NAME).write_text(json.dumps(sealed, indent=1, allow_nan=False))


def damaged_data_set(folder: Path) -> str | None:
    """The first file of a data set that is absent or not what was published; None if all are whole.

    The manifest lists the others by size and checksum.
    """
    manifest = sound_manifest(folder)
    return MANIFEST_NAME if manifest is None else damaged_file(folder, manifest[CHECKSUMS])


def sound_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a data set, if it is as it was written by its own digest; None if it is not."""
    try:
        manifest = dict(read_document(folder / MANIFEST_NAME))
    except StoreError:
        return None
    own = json_digest({key: value for key, value in manifest.items() if key != SEAL})
    return manifest if manifest.get(SEAL) == own else None


def stored_number(value: float) -> float | str | None:
    """A number as strict JSON holds it: None for NaN (undefined), "inf" or "-inf" for an infinite one."""
    if math.isnan(value):
        return None
    return str(value) if math.isinf(value) else value


def number_of(stored: float | str | None) -> float:
    """The number that `stored_number` made an entry of; NaN for None."""
    return math.nan if stored is None else float(stored)


def count_of(manifest: Mapping[str, Any], kind: str) -> int:
    """How many `scans` or `images` a manifest lists."""
    rows = manifest.get(kind, [])
    return len(rows) if isinstance(rows, list) else 0


def asked_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What a manifest's view asks for: its entry without the formats that it is written in."""
    view = manifest.get("view")
    return {key: value for key, value in view.items() if key != "exports"} if isinstance(view, dict) else {}
