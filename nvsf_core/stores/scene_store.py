"""Where a scene's outputs lie, and how they are published whole.

A reader sees the old version of an output or the new one, never half of one: the writer fills a
temporary folder beside the target, everything is flushed to disk, and one rename makes it visible.
"""

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.errors import StoreError

_TEMPORARY = ".publishing-"
_RETIRED = ".retired-"


@dataclass(frozen=True, slots=True)
class SceneStore:
    """The outputs of one scene under `<home>/<scene>/`."""

    home: Path
    """NVSF_HOME: the folder that holds all scenes' outputs."""
    scene: str
    """Name of the scene, its partition key."""

    @property
    def root(self) -> Path:
        """Folder of this scene."""
        return self.home / self.scene

    def path(self, relative: str) -> Path:
        """Folder of a published output, whether or not it exists yet."""
        return self.root / relative

    def require(self, relative: str) -> Path:
        """Folder of a published output.

        Raises:
            StoreError: It was never published.
        """
        path = self.path(relative)
        if not path.is_dir():
            raise StoreError(
                f"scene {self.scene}: no output {relative!r} at {path}; run the stage that makes it first"
            )
        return path

    def work_dir(self, relative: str) -> Path:
        """Scratch folder that outlives a killed process (checkpoints); made if absent."""
        path = self.root / ".work" / relative
        path.mkdir(parents=True, exist_ok=True)
        return path

    def drop_work_dir(self, relative: str) -> None:
        """Remove the scratch folder, once its content is published."""
        shutil.rmtree(self.root / ".work" / relative, ignore_errors=True)

    @contextlib.contextmanager
    def publish(self, relative: str) -> Iterator[Path]:
        """Give an empty folder to fill; on a clean exit it becomes `relative`, on an error it vanishes.

        Raises:
            OSError: The disk refused a write; the old output then still stands.
        """
        with publish_folder(self.path(relative)) as folder:
            yield folder


@contextlib.contextmanager
def publish_folder(target: Path) -> Iterator[Path]:
    """Fill a temporary folder that replaces `target` as a whole on a clean exit."""
    target.parent.mkdir(parents=True, exist_ok=True)
    _sweep_leftovers(target)
    temporary = target.parent / f"{_TEMPORARY}{target.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    temporary.mkdir()
    try:
        yield temporary
        _flush_tree(temporary)
        _swap_in(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _swap_in(temporary: Path, target: Path) -> None:
    if not target.exists():
        temporary.rename(target)
        _flush(target.parent)
        return
    # Linux cannot rename over a folder that is not empty: the old one steps aside first. Should the
    # process die between the two renames, `_sweep_leftovers` puts the old one back.
    retired = target.parent / f"{_RETIRED}{target.name}-{uuid.uuid4().hex[:8]}"
    target.rename(retired)
    temporary.rename(target)
    _flush(target.parent)
    shutil.rmtree(retired, ignore_errors=True)


def _sweep_leftovers(target: Path) -> None:
    """Undo what a killed writer left: restore a retired folder, remove dead temporaries."""
    for retired in target.parent.glob(f"{_RETIRED}{target.name}-*"):
        if target.exists():
            shutil.rmtree(retired, ignore_errors=True)
        else:
            retired.rename(target)
    for temporary in target.parent.glob(f"{_TEMPORARY}{target.name}-*"):
        pid = int(temporary.name.rsplit("-", 2)[1])
        if not Path(f"/proc/{pid}").exists():
            shutil.rmtree(temporary, ignore_errors=True)


def _flush_tree(folder: Path) -> None:
    for root, _, files in os.walk(folder):
        for name in files:
            _flush(Path(root) / name)
        _flush(Path(root))


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
