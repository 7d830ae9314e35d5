"""The Makefile: paths with blanks are refused in words, and an instance's configuration is the user's own."""

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


def test_a_newer_template_never_replaces_the_users_instance(checkout: Path, repo: Path) -> None:
    plain = checkout.rename(checkout.with_name("checkout"))
    for folder in ("pipelines", ".venv", "instance"):
        (plain / folder).mkdir()
    shutil.copy(repo / "pyproject.toml", plain)
    (plain / ".venv/.installed").touch()
    own, template = plain / "instance/dagster.yaml", plain / "pipelines/dagster.yaml"
    shutil.copy(repo / "pipelines/dagster.yaml", template)
    done = _make(plain, str(own), f"DAGSTER_HOME={own.parent}")
    assert "-m pipelines.instance" in done.stdout, done.stdout
    own.write_text("storage:\n  postgres:\n")
    os.utime(own, (1e9, 1e9))  # older than the template, as after a `git pull`
    done = _make(plain, str(own), f"DAGSTER_HOME={own.parent}")
    assert done.returncode == 0 and "pipelines" not in done.stdout, done.stdout
