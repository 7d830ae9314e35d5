"""Digests of recorded files by content: whether what a stage reads has changed.

A copied or moved drive has the same digest, whatever its place and the times of its files; changed bytes have
another.
"""

from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.section import Section
from nvsf_core.drives.view_truth import truth_files
from nvsf_core.errors import DataError
from nvsf_core.stores.checksums import json_digest
from nvsf_core.stores.file_hashes import FileHashes
from nvsf_core.stores.scene_store import SceneStore

HASHES = ".hashes"
"""Folder below a home of the remembered hashes, one document a scene."""


def hashes_of(store: SceneStore, *, read_anew: bool = False, until_s: float = float("inf")) -> FileHashes:
    """The remembered hashes of a scene's recorded files, to be used in a `with`."""
    document = store.home / HASHES / f"{store.scene}.json"
    return FileHashes(document, read_anew=read_anew, until_s=until_s)


def drive_digest(scene: SceneEntry, hashes: FileHashes) -> str:
    """Digest of all recorded files that the scene reads, by their names below its root and their content.

    Raises:
        DataError: A file cannot be read.
        TimeIsUpError: The time of `hashes` is up.
    """
    section = _section(scene)
    folders = [folder.relative_to(scene.root).as_posix() for folder in section.folders]
    return json_digest(
        {"files": _hashed(scene, section, hashes), "folders": folders, "recorded": section.recorded}
    )


def drive_files(scene: SceneEntry, hashes: FileHashes) -> dict[str, str]:
    """Name below the root to hash of all recorded files that the scene reads.

    Raises:
        DataError: A file cannot be read.
        TimeIsUpError: The time of `hashes` is up.
    """
    return _hashed(scene, _section(scene), hashes)


def _section(scene: SceneEntry) -> Section:
    try:
        return drive_of(scene).section()
    except OSError as error:
        raise _unreadable(scene, error) from error


def _hashed(scene: SceneEntry, section: Section, hashes: FileHashes) -> dict[str, str]:
    there = (path for path in section.files if path.exists())
    return {path.relative_to(scene.root).as_posix(): _hash(scene, path, hashes) for path in there}


def truth_digest(scene: SceneEntry, hashes: FileHashes) -> str:
    """Digest of the views' true images, by view, camera, name and content.

    Raises:
        DataError: A view names images that are not there, or a file cannot be read.
        TimeIsUpError: The time of `hashes` is up.
    """
    named = {}
    for view in scene.views:
        for camera, files in truth_files(scene, view).items():
            for path in files.values():
                named[f"{view.name} {camera} {path.name}"] = _hash(scene, path, hashes)
    return json_digest(named)


def _hash(scene: SceneEntry, path: Path, hashes: FileHashes) -> str:
    try:
        return hashes.hash_of(path)
    except OSError as error:
        raise _unreadable(scene, error) from error


def _unreadable(scene: SceneEntry, error: OSError) -> DataError:
    return DataError(
        f"scene {scene.name}: cannot read {error.filename or scene.root} ({error.strerror}); correct its "
        "permissions, or unpack the drive again"
    )
