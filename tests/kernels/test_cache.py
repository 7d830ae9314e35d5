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
from nvsf_core.kernels.voxel_march import count_passes

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
    walk.write_text(walk.read_text().replace("_FALL = 0.2", "_FALL = 0.3"))
    assert _where(tmp_path) != before


@pytest.mark.skipif(
    os.environ["NUMBA_CACHE_DIR"] != str(COMPILED), reason="NUMBA_CACHE_DIR names a folder of the user's"
)
def test_compiled_kernels_refer_to_no_module_but_those_that_decide_on_their_folder() -> None:
    index = voxels.index_points(np.zeros((1, 3), np.float32), 0.2)[0]
    ray = np.array([[1.0, 0.0, 0.0]], np.float32)
    count_passes(
        ray, ray, np.ones(1, np.float32), index, np.zeros((1, 3), np.float32), np.zeros((0, 6), np.float32)
    )
    kept = list(COMPILED.rglob("*.nbi"))
    assert kept
    named = {name for path in kept for name in re.findall(rb"nvsf_core(?:\.\w+)+", path.read_bytes())}
    allowed = {f"nvsf_core.{name[:-3].replace('/', '.')}" for name in TUPLES}
    assert {name for name in map(bytes.decode, named) if not name.startswith("nvsf_core.kernels")} <= allowed
    assert b"nvsf_core.geometry.voxels" in named
