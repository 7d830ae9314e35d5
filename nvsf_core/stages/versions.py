"""The versions of a scene's data sets: which there are, whether they are whole, and making one anew."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.errors import NvsfError
from nvsf_core.stages.exports.manifest import MANIFEST_NAME, damaged_data_set
from nvsf_core.stages.runner.locks import LOCKS, file_lock
from nvsf_core.stages.runner.record import RECORD_NAME, read_record
from nvsf_core.stages.runner.run import plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Progress
from nvsf_core.stores.scene_store import SceneStore, published

VERSIONS = "dataset"
"""Folder of all versions below a scene's, and the name of their lock."""
_INDEX = "dataset/.index"


@dataclass(frozen=True, slots=True, kw_only=True)
class Version:
    """One version of a scene's data set of one view."""

    view: str
    name: str
    """`<label>-<8 hex digits>`."""
    folder: Path

    @property
    def location(self) -> str:
        """Its place below the scene's folder."""
        return f"dataset/{self.view}/{self.name}"


def versions_of(store: SceneStore) -> Iterator[Version]:
    """All versions of a scene's data sets, by view and then by name."""
    for folder in published(store.root, "dataset/*/*"):
        if folder.is_dir() and not folder.parent.name.startswith("."):
            yield Version(view=folder.parent.name, name=folder.name, folder=folder)


def made_s(version: Version) -> float:
    """When a version was made, seconds since 1970, by its manifest, whose time a pin does not change."""
    manifest = version.folder / MANIFEST_NAME
    return (manifest if manifest.is_file() else version.folder).stat().st_mtime


def versions_lock(store: SceneStore) -> Path:
    """The lock file of a scene's versions: shared by who reads or makes them, held by who removes some."""
    return store.home / LOCKS / store.scene / f"{VERSIONS}.lock"


@contextlib.contextmanager
def reading_versions(home: Path, scenes: Iterable[str], progress: Progress) -> Iterator[None]:
    """Keep the versions of scenes' data sets from being removed while they are read."""
    with contextlib.ExitStack() as held:
        for scene in scenes:
            path, words = versions_lock(SceneStore(home, scene)), f"data sets of {scene}, of which some go"
            held.enter_context(file_lock(path, progress, words, shared=True))
        yield


def damage_of_version(version: Version) -> str | None:
    """The first file of a version that is not what was published; None if all are."""
    found = damaged_data_set(version.folder)
    return None if found is None else str(version.folder / found)


def damage_at_rest(store: SceneStore, version: Version, progress: Progress) -> str | None:
    """As `damage_of_version`, of a version that no run is writing at.

    While other errors are written into its manifest and card, or it is made anew, it looks damaged: such runs
    are waited for, and it is looked at again.
    """
    damage = damage_of_version(version)
    if damage is None:
        return None
    # In a home that cannot be written, as an archive, nobody makes a lock, and nobody writes.
    with contextlib.suppress(OSError), contextlib.ExitStack() as held:
        # Of runs of the stage `dataset`, by their indices, and of `nvsf view`, by the versions.
        for path in sorted(versions_lock(store).with_suffix("").rglob("*.lock")):
            words = f"data sets of {store.scene}, which another run writes"
            held.enter_context(file_lock(path, progress, words, shared=True))
        return damage_of_version(version)
    return damage


def make_anew(scene: SceneEntry, home: Path, version: Version, progress: Progress) -> bool:
    """Make a damaged version again, if all that it was made from is still the same; no other one is changed.

    Returns:
        Whether it is whole now. It cannot be made again if the model, the drive or the code has changed.

    """
    for folder in _made_by(SceneStore(home, scene.name), version):
        # As `Stage.location` names it: <recipe>/<seed>-<draw seed>-<label>.
        seed, draw_seed, label = folder.name.split("-", 2)
        try:
            run = plan_run(
                scene, home, recipe=folder.parent.name, seed=int(seed), draw_seed=int(draw_seed),
                dataset_label=label,
            )  # fmt: skip
            run_named_stage("dataset", run, progress)
        except NvsfError as error:
            progress(f"{version.location}: {error}")
    return damage_of_version(version) is None


def _made_by(store: SceneStore, version: Version) -> list[Path]:
    """The runs of the stage `dataset` that list this version, by their folders."""
    found = []
    for path in published(store.root, f"{_INDEX}/*/*/{RECORD_NAME}"):
        record = read_record(path.parent) or {}
        if version.location in record.get("files", {}):
            found.append(path.parent)
    return found
