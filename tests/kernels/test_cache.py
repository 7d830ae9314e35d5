"""Compiled kernels belong to the sources that they were compiled from, all of them."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nvsf_core import kernels
from nvsf_core.geometry import voxels
from nvsf_core.kernels.cache import COMPILED, TUPLES
from nvsf_core.kernels.voxel_passes import count_passes

_ASK = "import numba, nvsf_core.kernels.surfel_rendering as p; print(numba.config.CACHE_DIR, p.__file__)"


def _where(root: Path) -> str:
    # The folder that a parent process of another checkout has set is not taken over.
    assert "NUMBA_CACHE_DIR" in os.environ
    environ = os.environ | {"PYTHONPATH": str(root), "NUMBA_CACHE_DIR": str(COMPILED)}
    done = subprocess.run(
        [sys.executable, "-c", _ASK], env=environ, cwd=root, capture_output=True, text=True, check=True
    )
    folder, module = done.stdout.split()
    assert Path(module).is_relative_to(root)
    return folder


def test_another_kernel_s_change_gives_all_of_them_another_folder(tmp_path: Path) -> None:
    package = Path(kernels.__file__).parents[1]
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(package, tmp_path / "nvsf_core", ignore=ignored)
    before = _where(tmp_path)
    assert before == _where(tmp_path)
    assert Path(before).is_relative_to(tmp_path)
    walk = tmp_path / "nvsf_core" / "kernels" / "voxel_march.py"
    walk.write_text(walk.read_text().replace("_FALL = ", "_FALL = 2.0 * "))
    assert _where(tmp_path) != before


@pytest.mark.skipif(
    os.environ["NUMBA_CACHE_DIR"] != str(COMPILED), reason="NUMBA_CACHE_DIR names a folder of the user's"
)
def test_compiled_kernels_refer_to_no_module_but_those_that_decide_on_their_folder() -> None:
    index = voxels.index_points(np.zeros((1, 3), np.float32), 0.2)[0]
    ray = np.array([[1.0, 0.0, 0.0]], np.float32)
    none = np.zeros((1, 3), np.float32)
    count_passes(ray, ray, np.ones(1, np.float32), index, none, none, np.zeros((0, 6), np.float32))
    kept = list(COMPILED.rglob("*.nbi"))
    assert kept
    named = {name for path in kept for name in re.findall(rb"nvsf_core(?:\.\w+)+", path.read_bytes())}
    allowed = {f"nvsf_core.{name[:-3].replace('/', '.')}" for name in TUPLES}
    assert {name for name in map(bytes.decode, named) if not name.startswith("nvsf_core.kernels")} <= allowed
    assert b"nvsf_core.geometry.voxels" in named


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A copy of the package whose folder of kernels cannot be written, by nobody: a file is in its way."""
    root = tmp_path / "sealed"
    shutil.copytree(
        Path(kernels.__file__).parents[1], root / "nvsf_core", ignore=shutil.ignore_patterns("__pycache__")
    )
    (root / "nvsf_core/kernels/__pycache__").touch()
    return root


def _run(root: Path, cwd: Path, **environ: str) -> tuple[Path, bool]:
    ask = "import nvsf_core.kernels.cache as c, nvsf_core.kernels.bounds; print(c.COMPILED, c.IS_KEPT)"
    given = {"PATH": os.environ["PATH"], "PYTHONPATH": str(root), **environ}
    done = subprocess.run(
        [sys.executable, "-c", ask], env=given, cwd=cwd, capture_output=True, text=True, check=True
    )
    folder, is_kept = done.stdout.split()
    assert list(cwd.iterdir()) == []
    return Path(folder), is_kept == "True"


def test_kernels_of_a_sealed_package_are_kept_by_the_user_alone(sealed: Path, tmp_path: Path) -> None:
    for name in ("here", "home", "temporary", "caches"):
        (tmp_path / name).mkdir()
    home, temporary, here = tmp_path / "home", tmp_path / "temporary", tmp_path / "here"
    folder, is_kept = _run(sealed, here, HOME=str(home), TMPDIR=str(temporary))
    assert is_kept and folder.parent == home / ".cache/nvsf"
    assert folder.parent.stat().st_mode & 0o777 == 0o700
    # Somebody else could write there.
    folder.parent.chmod(0o777)
    folder, is_kept = _run(sealed, here, HOME=str(home), TMPDIR=str(temporary))
    assert is_kept and folder.parent == temporary / f"nvsf-{os.getuid()}"
    assert folder.parent.stat().st_mode & 0o777 == 0o700
    # A link may lead to what is not the user's.
    shutil.rmtree(folder.parent)
    folder.parent.symlink_to(tmp_path / "caches")
    folder, is_kept = _run(sealed, here, HOME=str(home), TMPDIR=str(temporary))
    assert not is_kept and folder.parent == temporary and not folder.exists()


def test_without_a_home_no_folder_is_made_here(sealed: Path, tmp_path: Path) -> None:
    for name in ("here", "temporary"):
        (tmp_path / name).mkdir()
    no_folder = str(sealed / "nvsf_core/__init__.py")
    environ = {"HOME": "~", "TMPDIR": str(tmp_path / "temporary"), "NUMBA_CACHE_DIR": no_folder}
    folder, is_kept = _run(sealed, tmp_path / "here", **environ)
    assert is_kept and folder.parent.parent == tmp_path / "temporary"
