"""Outputs that were removed on purpose: noted first, then taken away by one rename, then deleted.

A process that dies at any moment leaves the whole output, or one that a note says was removed. The note tells
such an output from a lost one.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from nvsf_core.errors import DataError, StoreError
from nvsf_core.stores.documents import read_document, remove_left_documents, write_document
from nvsf_core.stores.scene_store import SceneStore, flush, hide, published

KEEP_VARIABLE = "NVSF_KEEP_VERSIONS"
PIN_NAME = "PINNED"
"""A file of this name, which a user makes in an output's folder, keeps the output for ever."""
_NOTES = ".removed"
"""Folder of the notes below a scene's: one document an output, at the output's place."""
_KINDS: Mapping[str, type] = {"removed": str, "rule": str, "checksums": dict, "facts": dict}


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal:
    """What the note on a removed output says."""

    place: str
    """Of the output, below the scene's folder."""
    note: Path
    """The note's file. Without it the output counts as lost, and is made anew."""
    removed: str
    """When, UTC."""
    rule: str
    """Why, as `NVSF_KEEP_VERSIONS=3`."""
    checksums: Mapping[str, str]
    """File to size and checksum, of files by which the output is known again."""
    facts: Mapping[str, Any]
    """What stays known of it."""

    @property
    def words(self) -> str:
        """When and why, for users."""
        return f"removed on {self.removed[:10]} by {self.rule}"


def number_kept(environ: Mapping[str, str]) -> int | None:
    """How many versions of each data set are kept, by NVSF_KEEP_VERSIONS; None = all.

    Raises:
        DataError: It is not a whole number from 1 on.
    """
    wanted = environ.get(KEEP_VARIABLE, "")
    if not wanted:
        return None
    if not wanted.isdecimal() or int(wanted) < 1:
        raise DataError(
            f"{KEEP_VARIABLE}={wanted!r:.40}: expected a whole number of versions, 1 or more; correct it, or "
            "unset it to keep all"
        )
    return int(wanted)


def remove_output(
    store: SceneStore, place: str, rule: str, checksums: Mapping[str, str], facts: Mapping[str, Any]
) -> None:
    """Note that an output is removed, then take it away; `delete_hidden` then frees its space.

    Args:
        store: The scene's store.
        place: Of the output, below the scene's folder.
        rule: Why, in words.
        checksums: File to size and checksum, of files by which the output is known again.
        facts: What stays known of it, as JSON holds it.

    Raises:
        OSError: The disk refused; the output is there as before.
    """
    note = _note(store, place)
    note.parent.mkdir(parents=True, exist_ok=True)
    removed = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"
    write_document(
        note, {"removed": removed, "rule": rule, "checksums": dict(checksums), "facts": dict(facts)}
    )
    for folder in note.parents:  # after a power cut, too, there must be no removed output without its note
        flush(folder)
        if folder == store.root:
            break
    hide(store.path(place))


def removal_of(store: SceneStore, place: str) -> Removal | None:
    """The note on a removed output; None if it is there, or was never removed on purpose."""
    if os.path.lexists(store.path(place)):
        return None
    return _read(_note(store, place), place)


def removals(store: SceneStore, pattern: str) -> Iterator[Removal]:
    """The notes on outputs that are gone, of the places that match a glob pattern; sorted by place."""
    for place in noted_places(store, pattern):
        found = removal_of(store, place)
        if found is not None:
            yield found


def noted_places(store: SceneStore, pattern: str) -> list[str]:
    """Sorted places with a note, gone or not, that match a glob pattern; half-written notes are removed."""
    root = store.root / _NOTES
    for folder in published(store.root, f"{_NOTES}/{Path(pattern).parent}"):
        remove_left_documents(folder)
    paths = published(store.root, f"{_NOTES}/{pattern}.json")
    return [path.relative_to(root).as_posix().removesuffix(".json") for path in paths]


def forget_removal(store: SceneStore, place: str) -> None:
    """Delete the note on an output, which is there again or was never taken away."""
    _note(store, place).unlink(missing_ok=True)


def carry_pin(before: Path, now: Path) -> None:
    """Pin an output's new folder if the one that it replaces is pinned."""
    if os.path.lexists(before / PIN_NAME):
        (now / PIN_NAME).touch()


def _note(store: SceneStore, place: str) -> Path:
    return store.path(f"{_NOTES}/{place}.json")


def _read(path: Path, place: str) -> Removal | None:
    try:
        found = dict(read_document(path))
    except StoreError:
        return None
    if not all(isinstance(found.get(key), kind) for key, kind in _KINDS.items()):
        return None
    return Removal(place=place, note=path, **{key: found[key] for key in _KINDS})
