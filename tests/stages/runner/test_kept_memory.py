"""Freed memory stays in the process: in one of its own, as the setting is for good."""

import subprocess
import sys

import pytest

_PROGRAM = """
import resource
import numpy as np
from nvsf_core.stages.runner.resources import keep_freed_memory

def faults(times):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(times):
        np.full(25_000_000, 1.0, np.float32).sum()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

usual = faults(4)
kept = keep_freed_memory()
faults(1)
print(int(kept), usual, faults(4))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's setting; this system has another C library")
def test_large_arrays_reuse_their_pages() -> None:
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    kept, usual, after = (int(word) for word in done.stdout.split())
    assert kept == 1
    # Pages may be huge, so their number is compared and not known.
    assert after < usual / 4
