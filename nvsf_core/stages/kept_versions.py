"""Keeps a stated number of versions of each data set: the oldest beyond NVSF_KEEP_VERSIONS are removed.

Counted apart for each view, what it asks for, recipe and seed of training: the newest of what a report shows
or `nvsf join` looks for is always there. Called once a new version is published, never before.
"""

import json
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from nvsf_core.errors import StoreError
from nvsf_core.stages.exports.manifest import MANIFEST_NAME, SEAL, asked_of, count_of, sound_manifest
from nvsf_core.stages.runner.locks import free_lock
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.stage import Outcome, Progress
from nvsf_core.stages.versions import VERSIONS, Version, made_s, versions_lock, versions_of
from nvsf_core.stores.checksums import checksum_of
from nvsf_core.stores.documents import read_document, remove_left_documents, write_document
from nvsf_core.stores.removal import (
    KEEP_VARIABLE,
    PIN_NAME,
    forget_removal,
    noted_places,
    number_kept,
    remove_output,
)
from nvsf_core.stores.scene_store import SceneStore, delete_hidden

_VIEWS = f"{VERSIONS}/*"
_NOTED = f"{VERSIONS}/*/*"
_ORDER = f"{VERSIONS}/.order"
"""Folder of one document a view: its versions in the order of their making. Times of files are not it: clocks
jump, and a copied home has other ones."""
_TOLD = (
    "recipe", "seed", "draw_seed", "view", "source_checksums", "commit", "software", "rendered_from",
    "field_metrics", SEAL,
)  # fmt: skip
"""Entries of a removed version's manifest that its note keeps, for the page of versions."""
_Origin = tuple[str, int, str]
"""Name of the recipe, seed of training, and what the view asks for: views of one name may differ."""


def tidy_versions(store: SceneStore, outcome: Outcome, progress: Progress) -> None:
    """Remove what is beyond the number of the data sets that a run of the stage has made or found."""
    record = read_record(outcome.path) or {}
    keep_newest(store, record.get("files", {}).keys(), progress)


def keep_newest(store: SceneStore, own: Collection[str], progress: Progress) -> None:
    """Remove the oldest versions beyond the number that is kept, of the data sets that `own` belong to.

    None of `own`, places of versions just made or found, is removed. Also finishes what a killed process
    began. A disk that refuses is reported, and no error: the data sets are published.

    Raises:
        DataError: NVSF_KEEP_VERSIONS is not a whole number from 1 on.
    """
    number = number_kept(os.environ)
    try:
        with free_lock(versions_lock(store)) as is_free:
            if is_free:
                _keep(store, number, own, progress)
            elif number is not None:
                progress(f"[{store.scene}] {VERSIONS}: read by another run, so none is removed by this one")
        # Without the lock: what is hidden is nobody's, and to delete it takes long.
        delete_hidden(store.root, _VIEWS)
    except OSError as error:
        progress(
            f"[{store.scene}] {VERSIONS}: the disk refused {error.filename or store.root} ("
            f"{error.strerror or error}); older versions stay until the next run"
        )


def _keep(store: SceneStore, number: int | None, own: Collection[str], progress: Progress) -> None:
    """Note the order of the versions, and remove those that are beyond the number; the lock is held."""
    remove_left_documents(store.path(_ORDER))
    views: dict[str, list[Version]] = {}
    for version in versions_of(store):
        views.setdefault(version.view, []).append(version)
    for view, versions in views.items():
        ordered = _in_order(store, view, versions, own)
        _write_order(store, view, ordered)
        if number is None or not any(version.location in own for version in versions):
            continue
        for version in list(_beyond(ordered, number, own)):
            _remove(store, version, f"{KEEP_VARIABLE}={number}")
            progress(f"[{store.scene}] {version.location}: removed by {KEEP_VARIABLE}={number}")
            ordered.remove(version)
        _write_order(store, view, ordered)
    for place in noted_places(store, _NOTED):
        if store.path(place).is_dir():  # made again since, or its remover was killed and it is not beyond now
            forget_removal(store, place)


def in_order(store: SceneStore, view: str) -> list[Version]:
    """The versions of a view, the oldest first."""
    return _in_order(store, view, [one for one in versions_of(store) if one.view == view], ())


def _in_order(store: SceneStore, view: str, versions: list[Version], own: Collection[str]) -> list[Version]:
    """The versions of a view, the oldest first: as it was written down, then by their times, then `own`."""
    known = _written_order(store, view)

    def rank(version: Version) -> tuple[int, bool, float, str]:
        if version.name in known:
            return (known.index(version.name), False, 0.0, version.name)
        return (len(known), version.location in own, made_s(version), version.name)

    return sorted(versions, key=rank)


def _written_order(store: SceneStore, view: str) -> list[str]:
    try:
        names = read_document(store.path(f"{_ORDER}/{view}.json")).get("versions")
    except StoreError:
        return []
    return names if isinstance(names, list) else []


def _write_order(store: SceneStore, view: str, ordered: list[Version]) -> None:
    names = [version.name for version in ordered]
    if names != _written_order(store, view):
        document = store.path(f"{_ORDER}/{view}.json")
        document.parent.mkdir(parents=True, exist_ok=True)
        write_document(document, {"versions": names})


def _beyond(ordered: list[Version], number: int, own: Collection[str]) -> Iterator[Version]:
    """The versions that go, of those that have an origin in common with one of `own`."""
    origins = {version.location: _origin(version.folder) for version in ordered}
    for origin in {origins[place] for place in own if place in origins} - {None}:
        alike = [version for version in ordered if origins[version.location] == origin]
        for version in alike[:-number]:
            is_pinned = os.path.lexists(version.folder / PIN_NAME)
            if not is_pinned and version.location not in own:
                yield version


def _origin(folder: Path) -> _Origin | None:
    """What a version is of; None where its manifest does not say so or is damaged: it is never removed."""
    manifest = sound_manifest(folder) or {}
    recipe, seed = manifest.get("recipe"), manifest.get("seed")
    name = recipe.get("name") if isinstance(recipe, dict) else None
    if not isinstance(name, str) or not isinstance(seed, int):
        return None
    return name, seed, json.dumps(asked_of(manifest), sort_keys=True)


def _remove(store: SceneStore, version: Version, rule: str) -> None:
    manifest: dict[str, Any] = sound_manifest(version.folder) or {}
    files = [path for path in version.folder.rglob("*") if path.is_file()]
    facts = {
        **{key: manifest[key] for key in _TOLD if key in manifest},
        **{kind: count_of(manifest, kind) for kind in ("scans", "images")},
        "made_s": made_s(version),
        "megabytes": sum(path.stat().st_size for path in files) / 1e6,
    }
    checksums = {MANIFEST_NAME: checksum_of(version.folder / MANIFEST_NAME)}
    remove_output(store, version.location, rule, checksums, facts)
