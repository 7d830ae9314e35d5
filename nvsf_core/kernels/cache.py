"""Where compiled kernels are kept; imported before numba is, which reads it from the environment.

Numba looks at the file of the function that was called alone: one that calls a kernel of another file would
go on with what that was before it changed. So each state of all sources here has a folder of its own. What is
kept also refers to the named tuples that kernels were called with, by their modules: these are sources, too.

Where the package's folder cannot be written, as of an installation for all users, a folder of the user's own
is taken. Nobody else may write there: what is kept is unpickled.
"""

import atexit
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

_OURS = "nvsf-kernels-"
_HERE = Path(__file__).parent
TUPLES = ("geometry/voxels.py", "fields/lidar_field.py")
"""Files of the core, outside this folder, whose named tuples kernels take."""
_FILES = (*sorted(_HERE.rglob("*.py")), *(_HERE.parent / name for name in TUPLES))
_SOURCES = b"".join(str(path.relative_to(_HERE.parent)).encode() + path.read_bytes() for path in _FILES)
_NAME = f"{_OURS}{hashlib.sha256(_SOURCES).hexdigest()[:16]}"


def _bears_files(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if need be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _users_places() -> Iterator[Path]:
    """Folders for files of the user's: with other caches, else with temporary files."""
    # Of a user without a home `~` stays as it is, and would be a folder here.
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    if os.path.isabs(caches):
        yield Path(caches) / "nvsf"
    yield Path(tempfile.gettempdir()) / f"nvsf-{os.getuid()}"


def _is_own(folder: Path) -> bool:
    """Whether a folder, made if need be, is the user's, and nobody else may write there."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # and not one that was forked from it
        shutil.rmtree(folder, ignore_errors=True)


def _choose() -> tuple[Path, bool]:
    """The first folder that can be written, and whether later processes find it again."""
    if _bears_files(_BESIDE):
        return _BESIDE, True
    for place in _users_places():
        if _is_own(place) and _bears_files(place / _NAME):
            return place / _NAME, True
    own = Path(tempfile.mkdtemp(prefix=_OURS))
    atexit.register(_remove, own, os.getpid())
    return own, False


_BESIDE = _HERE / "__pycache__" / _NAME
COMPILED, IS_KEPT = _BESIDE, True
"""The folder, unless NUMBA_CACHE_DIR names one that can be written and that no parent process of ours has
set; and whether it stays after this process."""

_named = Path(os.environ.get("NUMBA_CACHE_DIR", _OURS))
if _named.name.startswith(_OURS) or not _bears_files(_named):
    COMPILED, IS_KEPT = _choose()
    os.environ["NUMBA_CACHE_DIR"] = str(COMPILED)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(COMPILED)
