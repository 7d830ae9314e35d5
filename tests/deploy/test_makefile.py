"""Make splits lists at blanks: where a path has one, nothing is done, and the message says what to do."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest


def _make(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    # The tests may be run by make, whose own variables would change what this one prints.
    others = ("NVSF_HOME", "DAGSTER_HOME", "MAKEFLAGS", "MAKELEVEL", "MFLAGS")
    clean = {key: value for key, value in os.environ.items() if key not in others}
    return subprocess.run(["make", "-n", *words], cwd=folder, env=clean, capture_output=True, text=True)


@pytest.fixture
def checkout(repo: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "a checkout"
    folder.mkdir()
    shutil.copy(repo / "Makefile", folder)
    return folder


def test_a_checkout_in_a_path_with_blanks_is_refused(checkout: Path) -> None:
    done = _make(checkout, "demo")
    assert done.returncode == 2 and done.stdout == ""
    assert f'found "{checkout}": move it' in done.stderr


@pytest.mark.parametrize("name", ["NVSF_HOME", "DAGSTER_HOME"])
def test_a_home_with_blanks_is_refused(checkout: Path, name: str) -> None:
    plain = checkout.rename(checkout.with_name("checkout"))
    assert _make(plain, "help").returncode == 0
    done = _make(plain, "help", f"{name}=/somewhere/my home")
    assert done.returncode == 2 and "expected NVSF_HOME and DAGSTER_HOME without blanks" in done.stderr
