"""Parallel kernels may be called from several threads, and their first call does not warn of open3d's TBB."""

import os
import subprocess
import sys

import pytest

PROCESS = """
from concurrent.futures import ThreadPoolExecutor
import torch
from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.errors import MissingLibraryError
from nvsf_core.kernels.encodings.hash_grid import GridLayout, hash_grid_encode

try:
    load_open3d()  # brings a TBB that is too old for numba
except MissingLibraryError:
    pass
layout = GridLayout(levels=4, features=2, log2_table=12, base_resolution=4, finest_resolution=64)
table = torch.rand(layout.entries, 2)
points = [torch.rand(20_000, 3) for _ in range(8)]
alone = [hash_grid_encode(one, table, layout) for one in points]
import numba
print(numba.threading_layer(), flush=True)
with ThreadPoolExecutor(4) as pool:
    together = list(pool.map(lambda one: hash_grid_encode(one, table, layout), points * 4))
print(all(torch.equal(found, alone[i % 8]) for i, found in enumerate(together)))
"""


WITHOUT_OPENMP = """
import sys
sys.modules["numba.np.ufunc.omppool"] = None  # as on a machine without libgomp1: its import fails
import numba, torch
from nvsf_core.kernels.encodings.hash_grid import GridLayout, hash_grid_encode
from nvsf_core.kernels.threads import in_parts

layout = GridLayout(levels=4, features=2, log2_table=12, base_resolution=4, finest_resolution=64)
table, points = torch.rand(layout.entries, 2), torch.rand(20_000, 3)
alone = hash_grid_encode(points, table, layout)
parts = in_parts(lambda _: hash_grid_encode(points, table, layout), 64)
print(numba.threading_layer(), all(torch.equal(one, alone) for one in parts))
"""


def test_without_openmp_parts_are_done_one_after_the_other_instead_of_ending_the_process():
    environment = {**os.environ, "NVSF_THREADS": "4", "NUMBA_THREADING_LAYER_PRIORITY": "omp workqueue tbb"}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_OPENMP], capture_output=True, text=True, check=False, env=environment
    )
    assert (done.returncode, done.stdout) == (0, "workqueue True\n"), done.stderr


def test_threads_that_encode_at_once_get_what_one_gets_and_nobody_is_warned():
    done = subprocess.run([sys.executable, "-c", PROCESS], capture_output=True, text=True, check=False)
    assert "NumbaWarning" not in done.stderr
    if done.stdout.startswith("workqueue"):
        pytest.skip("neither OpenMP nor TBB on this machine, kernels bear one thread only: install libgomp1")
    assert done.returncode == 0, done.stderr
    layer, same = done.stdout.split()
    assert layer in ("omp", "tbb") and same == "True"
