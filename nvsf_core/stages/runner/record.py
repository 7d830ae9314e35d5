"""The record of each output, `stage.json`: its fingerprint, metadata, checks and file checksums."""

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from nvsf_core.errors import StoreError
from nvsf_core.stores.checksums import damaged_file, file_checksums, json_digest
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.removal import PIN_NAME, Removal, removal_of
from nvsf_core.stores.scene_store import SceneStore

RECORD_NAME = "stage.json"
_OWN = "."
"""Key of the record's own folder among the folders whose files it lists."""
_KINDS: dict[str, type | tuple[type, ...]] = {
    "fingerprint": str, "facts": dict, "version": str, "metadata": dict, "previews": dict, "checks": list,
    "check_version": str, "files": dict, "resources": dict,
}  # fmt: skip
_CHECK_KINDS: dict[str, type | tuple[type, ...]] = {
    "name": str, "passed": bool, "detail": str, "blocking": bool, "unit": str,
    "value": (int, float, type(None)), "limit": (int, float, type(None)),
}  # fmt: skip
_LARGEST = 2**63
_LONGEST_PATH = 1000
_CHECK_NEEDS = frozenset({"name", "passed", "detail"})
_CURVE = "curve.parquet"
_COSTS = ("_seconds", "_memory_mb")


def read_record(folder: Path) -> dict[str, Any] | None:
    """The record of a published output; None if it is absent or damaged (the stage then runs again)."""
    try:
        record = read_document(folder / RECORD_NAME)
    except StoreError:
        return None
    return record if _is_record(record) else None


def made_s(folder: Path) -> float:
    """When a published output was made, seconds since the epoch.

    The record says it, for a copy gives its files other times; of a damaged one the file's counts.
    """
    record = read_record(folder)
    return float((folder / RECORD_NAME).stat().st_mtime if record is None else record["made_s"])


def listed_files(
    store: SceneStore, folder: Path, previews: Iterable[str], beside: Iterable[str]
) -> dict[str, dict[str, str]]:
    """Folder to file to size and checksum, for all files of an output except its previews.

    No stage reads previews, so none is repeated because one is missing.
    """
    own = file_checksums(folder, frozenset({RECORD_NAME, *previews}))
    return {_OWN: own, **{place: _beside(store, place) for place in beside}}


def _beside(store: SceneStore, place: str) -> dict[str, str]:
    """The files of an output beside a record's own; of a removed one those by which it is known."""
    removal = removal_of(store, place)
    if removal is not None:
        return dict(removal.checksums)
    return file_checksums(store.path(place), frozenset({PIN_NAME}))


def content_of(record: Mapping[str, Any]) -> str:
    """SHA-256 of the checksums of an output's files: what its readers depend on.

    Training curves, and arrays that are named as seconds or memory, are left out: what making an output cost
    differs each time, and the same scans and images are to be the same version.
    """
    return json_digest(
        {
            place: {name: checksum for name, checksum in files.items() if not _is_cost(name)}
            for place, files in record["files"].items()
        }
    )


def _is_cost(name: str) -> bool:
    return any(part == _CURVE or part.endswith(_COSTS) for part in PurePosixPath(name).parts)


def damage_of(store: SceneStore, location: str, record: Mapping[str, Any]) -> str | None:
    """The first file of an output that is absent or changed; None if all are as published.

    What was removed on purpose, by its note, is no damage.
    """
    for place, files in record["files"].items():
        folder = store.recovered(location if place == _OWN else place)
        name = damaged_file(folder, files)
        # The note comes before the removal: an output that is taken away while it is read has one, too.
        if name is not None and _removal(store, place, files) is None:
            return str(folder / name)
    return None


def removals_of(store: SceneStore, record: Mapping[str, Any]) -> list[Removal]:
    """The outputs beside a record's own that were removed on purpose since."""
    found = [_removal(store, place, files) for place, files in record["files"].items()]
    return [one for one in found if one is not None]


def _removal(store: SceneStore, place: str, files: Mapping[str, str]) -> Removal | None:
    """The note on an output beside a record's own; None if it is there, lost, or was another one."""
    found = None if place == _OWN else removal_of(store, place)
    if found is None or not found.checksums:
        return None
    return found if all(files.get(name) == one for name, one in found.checksums.items()) else None


def _is_record(record: Mapping[str, Any]) -> bool:
    if not all(isinstance(record.get(key), kind) for key, kind in _KINDS.items()):
        return False
    return (
        _is_number(record.get("seconds"))
        and _is_number(record.get("made_s"))
        and all(_is_scalar(value) for value in record["metadata"].values())
        and all(_is_inside(file) for file in record["previews"].values())
        and all(_is_check(check) for check in record["checks"])
        and _lists_files(record["files"])
        and all(_is_number(value) for value in record["resources"].values())
    )


def _is_check(check: Any) -> bool:
    return (
        isinstance(check, dict)
        and check.keys() >= _CHECK_NEEDS
        and check.keys() <= _CHECK_KINDS.keys()
        and all(isinstance(value, _CHECK_KINDS[key]) for key, value in check.items())
        and all(_is_scalar(value) for value in check.values() if value is not None)
        and all(check.get(key) is None or _is_number(check[key]) for key in ("value", "limit"))
    )


def _is_scalar(value: Any) -> bool:
    return isinstance(value, bool) or _is_number(value) or _is_text(value)


def _is_number(value: Any) -> bool:
    """Whether the value is a number that fits a float; NaN and infinity are allowed."""
    return isinstance(value, float) or (
        isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST
    )


def _is_text(value: Any) -> bool:
    """Whether the value is text that UTF-8 can encode: JSON can hold lone surrogates."""
    return isinstance(value, str) and value == value.encode(errors="ignore").decode()


def _lists_files(listed: dict[Any, Any]) -> bool:
    return all(
        _is_inside(place)
        and isinstance(files, dict)
        and all(_is_inside(name) and isinstance(checksum, str) for name, checksum in files.items())
        for place, files in listed.items()
    )


def _is_inside(path: Any) -> bool:
    """Whether a path is relative and stays below its folder."""
    if not _is_text(path) or not 0 < len(path) <= _LONGEST_PATH or "\0" in path:
        return False
    parts = PurePosixPath(path)
    return not parts.is_absolute() and ".." not in parts.parts
