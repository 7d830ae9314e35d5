"""Of which drive a scene's outputs were made: another drive of the same name must not replace them.

A drive is known by its content. Where it lies may change, and so may some of its files; what lies elsewhere
and has other content is another drive.
"""

from collections.abc import Mapping
from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.contents import drive_files, hashes_of
from nvsf_core.stages.runner.stage import Progress
from nvsf_core.stores.documents import read_document, write_document
from nvsf_core.stores.scene_store import SceneStore

_NAME = ".drive.json"
"""Document in the scene's folder: `root`, and `files`, name below it to hash; hidden, for it is no output."""
_LEAST_SHARED = 0.5
"""Of the files of the smaller of two drives; two drives of one car share their calibration only."""
_MOST_NAMED = 3


class OtherDriveError(StoreError):
    """The home holds outputs of another drive under the scene's name."""


def require_same_drive(store: SceneStore, scene: SceneEntry, progress: Progress) -> None:
    """Refuse to replace what was made of another drive; say what of the drive itself has changed.

    Raises:
        OtherDriveError: The outputs were made of a drive that lay elsewhere and shares few files with it.
        DataError: A recorded file cannot be read.
    """
    root, before = _remembered(store)
    if not before:
        return
    now = _files(store, scene)
    shared = len({*before.values()} & {*now.values()})
    fewer = min(len({*before.values()}), len({*now.values()}))
    if root != scene.root.resolve() and shared < _LEAST_SHARED * fewer:
        raise OtherDriveError(
            f"this home holds another drive of that name: {root}; it shares {shared} of the {len(now)} files "
            f"of {scene.root}. Choose another name (`name` in the catalogue, `nvsf import --name`) or "
            f"another NVSF_HOME; if it is that drive, corrected, delete {store.root / _NAME} and run again: "
            "what was made of it is then replaced"
        )
    changed = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    if changed:
        named = ", ".join(changed[:_MOST_NAMED]) + (", ..." if len(changed) > _MOST_NAMED else "")
        progress(
            f"[{scene.name}] drive: {len(changed)} of its files are not those that its outputs were made of "
            f"({named}): what follows from them is made again and replaced, also trained fields"
        )


def remember_drive(store: SceneStore, scene: SceneEntry) -> None:
    """Write down of which drive the scene's outputs are made, where that is not written yet.

    Raises:
        DataError: A recorded file cannot be read.
    """
    root, files = scene.root.resolve(), _files(store, scene)
    if _remembered(store) != (root, files):
        write_document(store.path(_NAME), {"root": str(root), "files": files})


def other_root(store: SceneStore, scene: SceneEntry) -> Path | None:
    """Where the drive lay that a scene's outputs were made of, if that is not where it lies now."""
    root, _ = _remembered(store)
    return None if root in (None, scene.root.resolve()) else root


def _files(store: SceneStore, scene: SceneEntry) -> dict[str, str]:
    with hashes_of(store) as hashes:
        return drive_files(scene, hashes)


def _remembered(store: SceneStore) -> tuple[Path | None, Mapping[str, str]]:
    """Root and files of the drive; nothing of outputs of an earlier version, or by a damaged document."""
    try:
        found = read_document(store.path(_NAME))
    except StoreError:
        return None, {}
    root, files = found.get("root"), found.get("files")
    if not isinstance(root, str) or not isinstance(files, dict):
        return None, {}
    return Path(root), {name: one for name, one in files.items() if isinstance(one, str)}
