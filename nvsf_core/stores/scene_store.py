"""Folders of a scene's outputs, and atomic publication of an output.

A reader sees the old version of an output or the new one, never a part: the writer fills a temporary folder
beside the target, everything is flushed to disk, and one rename makes it visible.
"""

import contextlib
import errno
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.errors import StoreError
from nvsf_core.names import RESERVED_SCENES, name_fault
from nvsf_core.stores.writers import TEMPORARY, leftovers, temporary_of, unforgotten

_RETIRED = ".retired-"
_REMOVING = ".removing-"
"""Of an output that is being deleted: never restored."""
_LONGEST_HOME = 1000
"""Most characters of NVSF_HOME: a path may have 4096 bytes, and outputs add some 200."""
_TRIED_BYTES = 2**16
"""More than a write leaves in Python's buffer, less than a second's work on any disk."""
_CHANCE = re.compile(r"[0-9a-f]{8}")
"""Ending of a retired folder's name: random digits."""
_OCCUPIED = (errno.ENOTEMPTY, errno.EEXIST)
_MOST_SWAPS = 5
"""Tries to put a new output in its place while readers put the old one back, which each can do once."""


def require_home(home: Path) -> Path:
    """Check that outputs can be written below `home`, which need not exist yet; returns its absolute path.

    Raises:
        StoreError: It, or its nearest existing parent, is no folder or not writable.
    """
    home = Path(home)
    text = str(home)
    if len(text) > _LONGEST_HOME or not text.isprintable():
        raise StoreError(
            f"NVSF_HOME: expected at most {_LONGEST_HOME} printable characters, found {text!r:.100}; choose "
            "another folder"
        )
    try:
        home = home.resolve()
        nearest = next(path for path in (home, *home.parents) if path.exists())
        fault = why_not_writable(nearest) if nearest.is_dir() else "which is no folder"
    except (OSError, ValueError, RuntimeError) as error:  # too long, a NUL, circular links
        raise StoreError(f"NVSF_HOME: expected a folder, found {str(home)!r:.200} ({error})") from error
    if fault is not None:
        raise StoreError(f"NVSF_HOME={home}: expected a folder to write to, found {nearest}, {fault}")
    return home


def why_not_writable(folder: Path) -> str | None:
    """Why a small file cannot be written in a folder; None if it can.

    It is tried: for root, permissions allow everything, even on a read-only disk and in /proc, and a full
    disk still takes an empty file.
    """
    try:
        with tempfile.TemporaryFile(prefix=".nvsf-", dir=folder) as file:
            file.write(bytes(_TRIED_BYTES))
            file.flush()
    except OSError as error:
        return f"which cannot be written to ({error.strerror or error}); check space and rights"
    return None


@dataclass(frozen=True, slots=True)
class SceneStore:
    """The outputs of one scene under `<home>/<scene>/`."""

    home: Path
    """NVSF_HOME: the folder of all scenes' outputs."""
    scene: str
    """Name of the scene, its partition key."""

    def __post_init__(self) -> None:
        """Refuse a name that cannot be a scene's folder."""
        fault = name_fault(self.scene, RESERVED_SCENES)
        if fault is not None:
            raise StoreError(f"scene: {fault}")

    @property
    def root(self) -> Path:
        """Folder of the scene."""
        return self.home / self.scene

    def path(self, relative: str) -> Path:
        """Folder of a published output, whether or not it exists yet.

        Raises:
            StoreError: It does not lie in the scene's folder: because of `..`, an absolute path, or a link.
        """
        # The home may be a link, for example to a larger disk; the scene's folder in it may not.
        root = self.home.resolve() / self.scene
        path = self.root / relative
        if "\0" in relative or ".." in path.parts or Path(relative).is_absolute():
            raise StoreError(
                f"scene {self.scene}: expected an output's folder below {root}, found {relative!r}"
            )
        if path == self.root or not _is_plain(path, root / relative):
            raise StoreError(
                f"scene {self.scene}: output {relative!r} is a link, or lies below one: out of {root}, into "
                "another output, or in a circle; replace it by a folder (NVSF_HOME itself may be a link)"
            )
        return path

    def recovered(self, relative: str) -> Path:
        """Folder of an output; restored first if a writer died between its two renames.

        What other dead writers left beside it is removed: an output that is up to date has no next writer.

        Raises:
            StoreError: See `path`.
        """
        path = self.path(relative)
        if path.parent.is_dir():
            _sweep_leftovers(path)
        return path

    def require(self, relative: str) -> Path:
        """Folder of a published output.

        Raises:
            StoreError: It was never published, or lies elsewhere (see `path`).
        """
        path = self.recovered(relative)
        if not path.is_dir():
            raise StoreError(
                f"scene {self.scene}: no output {relative!r} at {path}; run the stage that makes it first"
            )
        return path

    def work_dir(self, relative: str) -> Path:
        """Scratch folder that survives a killed process (for checkpoints); made if absent."""
        path = self.path(f".work/{relative}")
        path.mkdir(parents=True, exist_ok=True)
        return path

    def drop_work_dir(self, relative: str) -> None:
        """Remove the scratch folder, after the output is published."""
        shutil.rmtree(self.path(f".work/{relative}"), ignore_errors=True)

    @contextlib.contextmanager
    def publish(self, relative: str) -> Iterator[Path]:
        """Yield an empty folder to fill; without an error it becomes the output, else it is removed.

        Raises:
            OSError: A write failed; the old output is unchanged.
        """
        with publish_folder(self.path(relative)) as folder:
            yield folder


def _is_plain(path: Path, place: Path) -> bool:
    """Whether a path resolves to `place`, without links on the way."""
    try:
        return path.resolve() == place
    except (OSError, RuntimeError, ValueError):  # circular links, impossible names
        return False


def published(root: Path, pattern: str) -> list[Path]:
    """Sorted paths below `root` that match a glob pattern; without links and leftovers of killed writers."""
    hidden = (TEMPORARY, _RETIRED, _REMOVING, ".work")
    return [
        path
        for path in sorted(root.glob(pattern))
        if not any(part.startswith(hidden) for part in path.relative_to(root).parts)
        and _is_plain(path, root.resolve() / path.relative_to(root))
    ]


def hide(path: Path) -> None:
    """Take an output away by one rename; `delete_hidden` deletes it, in this process or a later one."""
    path.rename(path.parent / f"{_REMOVING}{path.name}-{uuid.uuid4().hex[:8]}")
    flush(path.parent)


def delete_hidden(root: Path, pattern: str) -> None:
    """Delete what `hide` took away, in the folders below `root` that match a glob pattern."""
    for path in root.glob(f"{pattern}/{_REMOVING}*"):
        if _is_plain(path, root.resolve() / path.relative_to(root)):
            _remove(path)


@contextlib.contextmanager
def publish_folder(target: Path) -> Iterator[Path]:
    """Yield a temporary folder to fill; without an error it replaces `target` as a whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    _sweep_leftovers(target)
    temporary = temporary_of(target)
    temporary.mkdir()
    try:
        with unforgotten(temporary):
            yield temporary
        _flush_tree(temporary)
        _swap_in(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yield a temporary folder to fill; without an error `target`, absent or empty before, has its content.

    Raises:
        OSError: There are files in `target` by then: they stay.
    """
    target = target.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    for folder in (target.parent, target):
        for temporary in leftovers(folder):
            _remove(temporary)
    # A folder that is there may be a mounted disk, which can be filled but not replaced.
    is_there = target.is_dir()
    temporary = temporary_of(target / target.name if is_there else target)
    temporary.mkdir()
    try:
        with unforgotten(temporary):
            yield temporary
        _flush_tree(temporary)
        if not is_there:
            temporary.rename(target)
        elif any(one != temporary for one in target.iterdir()):
            raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY), str(target))
        else:
            for one in list(temporary.iterdir()):
                one.rename(target / one.name)
        flush(target if is_there else target.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _swap_in(temporary: Path, target: Path) -> None:
    """Put a folder in its place; what was there is gone once the new one is."""
    # Linux cannot rename over a folder that is not empty, so the old one is renamed first. If the process
    # dies between the two renames, `_sweep_leftovers` restores the old one. A reader that comes between them
    # takes the writer for dead and does so, too; then both are renamed again.
    for attempt in range(_MOST_SWAPS):
        retired = _retire(target)
        try:
            temporary.rename(target)
            break
        except OSError as error:
            if error.errno not in _OCCUPIED or attempt == _MOST_SWAPS - 1:
                _put_back(retired, target)
                raise
    flush(target.parent)
    if retired is not None:
        _remove(retired)


def _put_back(retired: Path | None, target: Path) -> None:
    """Restore a retired output; another process may have done so, or have published another meanwhile."""
    if retired is None:
        return
    try:
        retired.rename(target)
    except FileNotFoundError:
        return
    except OSError as error:
        if error.errno not in _OCCUPIED:
            raise
        _remove(retired)


def _retire(target: Path) -> Path | None:
    """Rename an output, or what lies in its place, out of the way; its new name."""
    retired = target.parent / f"{_RETIRED}{target.name}-{uuid.uuid4().hex[:8]}"
    try:
        target.rename(retired)
    except FileNotFoundError:
        return None
    return retired


def _sweep_leftovers(target: Path) -> None:
    """Clean up after a killed writer: restore a retired folder, remove temporary ones of dead processes."""
    for retired in _retired(target):
        if target.exists():
            _remove(retired)
        else:
            _put_back(retired, target)
    # Of every output in the folder: what was left of a version that is never made again would stay for ever.
    for temporary in leftovers(target.parent):
        _remove(temporary)


def _retired(target: Path) -> list[Path]:
    """Retired folders of this target, not of one whose name only begins alike (`left` and `left-2`)."""
    start = f"{_RETIRED}{target.name}-"
    hidden = [path for path in target.parent.iterdir() if path.name.startswith(start)]
    return [path for path in hidden if _CHANCE.fullmatch(path.name.removeprefix(start))]


def _remove(path: Path) -> None:
    """Remove a folder with its content, or a file or link in its place."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _flush_tree(folder: Path) -> None:
    for root, _, files in os.walk(folder):
        for name in files:
            flush(Path(root) / name)
        flush(Path(root))


def flush(path: Path) -> None:
    """Write a file's bytes, or a folder's names, from memory to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
