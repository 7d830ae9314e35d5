"""Collects the versions of all data sets of a home for the page that compares them."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from nvsf_core.errors import StoreError
from nvsf_core.reporting.versions import VersionFacts, versions_html
from nvsf_core.stages.exports.manifest import MANIFEST_NAME, count_of, number_of
from nvsf_core.stages.versions import VERSIONS, Version, made_s, versions_of
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.removal import Removal, removals
from nvsf_core.stores.scene_store import SceneStore

VERSIONS_PAGE = "versions.html"
_NOTED = f"{VERSIONS}/*/*"
_KINDS: Mapping[str, type] = dict.fromkeys(
    ("recipe", "view", "source_checksums", "software", "rendered_from"), dict
)
"""Kinds of a manifest's entries: what is of another one is left out, for a page must not fail by one file."""
_INFINITE = ("inf", "-inf")
"""Metrics that are infinite, as a manifest holds them."""
_LARGEST = 1e11
"""Of seconds and of megabytes; beyond it a note is damaged."""


def write_versions_page(folder: Path, home: Path, scenes: Sequence[str]) -> Path:
    """Write the page into a folder; returns its path."""
    facts = [one for scene in scenes for one in _facts_of(SceneStore(home, scene))]
    path = folder / VERSIONS_PAGE
    path.write_text(versions_html(facts), encoding="utf-8", errors="backslashreplace")
    return path


def made_from(home: Path, scenes: Sequence[str]) -> list[Path]:
    """The files that the page is made from: manifests, and notes on removed versions."""
    found: list[Path] = []
    for scene in scenes:
        store = SceneStore(home, scene)
        found += [version.folder / MANIFEST_NAME for version in versions_of(store)]
        found += [one.note for one in removals(store, _NOTED)]
    return [path for path in found if path.is_file()]


def _facts_of(store: SceneStore) -> Iterator[VersionFacts]:
    """The versions that are there, then those that were removed."""
    for version in versions_of(store):
        try:
            yield _facts(store.scene, version)
        except FileNotFoundError:  # removed while the page is made: its note is among the next
            continue
    yield from (_removed_facts(store.scene, one) for one in removals(store, _NOTED))


def _facts(scene: str, version: Version) -> VersionFacts:
    try:
        manifest = dict(read_document(version.folder / MANIFEST_NAME))
    except StoreError:
        manifest = {}
    files = [path for path in version.folder.rglob("*") if path.is_file()]
    return VersionFacts(
        scene=scene, view=version.view, name=version.name, made_s=made_s(version),
        megabytes=sum(path.stat().st_size for path in files) / 1e6, scans=count_of(manifest, "scans"),
        images=count_of(manifest, "images"), manifest=_readable(manifest),
    )  # fmt: skip


def _removed_facts(scene: str, removal: Removal) -> VersionFacts:
    _, view, name = removal.place.split("/")
    made, megabytes, scans, images = (
        _number(removal.facts.get(key)) for key in ("made_s", "megabytes", "scans", "images")
    )
    return VersionFacts(
        scene=scene, view=view, name=name, made_s=made, megabytes=megabytes, scans=int(scans),
        images=int(images), manifest=_readable(removal.facts), removed=removal.words,
    )  # fmt: skip


def _number(value: object) -> float:
    """A number that a page can show; 0 for what is none."""
    return value if isinstance(value, int | float) and 0 <= value < _LARGEST else 0.0


def _readable(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a manifest whose kind is right."""
    rows = manifest.get("field_metrics")
    metrics = [_read(row) for row in rows if _is_metric(row)] if isinstance(rows, list) else []
    found = {key: value for key, value in manifest.items() if isinstance(value, _KINDS.get(key, object))}
    return found | ({"field_metrics": metrics} if found else {})


def _read(row: dict[str, Any]) -> dict[str, Any]:
    """A metric whose value, if it is infinite, is a number again."""
    return {**row, "value": number_of(row["value"])} if row.get("value") in _INFINITE else row


def _is_metric(row: object) -> bool:
    if not isinstance(row, dict):
        return False
    return isinstance(row.get("value"), int | float | None) or row["value"] in _INFINITE
