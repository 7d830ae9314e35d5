"""Tests of files that may not be read skip for root, who may read all: here they run without that right."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

_DROP = 24
"""`PR_CAPBSET_DROP` of prctl(2): a program that is started has this capability no more."""
_MAY_READ_ALL = (1, 2)
"""`CAP_DAC_OVERRIDE` and `CAP_DAC_READ_SEARCH`."""
_TESTS = (
    "tests/stores/test_permissions.py",
    "tests/pipelines/test_cli.py::test_a_scene_that_may_not_be_entered_is_named_and_the_others_are_listed",
    "tests/pipelines/test_cli.py::test_the_doctor_goes_on_where_folders_may_not_be_entered",
)


def _bound_by_permissions() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    for one in _MAY_READ_ALL:
        if libc.prctl(_DROP, one, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl")


@pytest.mark.cli
@pytest.mark.skipif(os.geteuid() != 0, reason="these tests run by themselves: this user is not root")
def test_what_skips_for_root_holds_for_everybody_else(repo: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *_TESTS]
    done = subprocess.run(
        command, cwd=repo, capture_output=True, text=True, preexec_fn=_bound_by_permissions, timeout=200
    )
    assert done.returncode == 0 and done.stdout.startswith("......"), done.stdout  # none is an s
