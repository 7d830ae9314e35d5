"""A new Dagster instance is made by one process, whole or not at all, and never again."""

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from nvsf_core.errors import StoreError
from pipelines.cli import main
from pipelines.instance import TEMPLATE, make_instance
from tests.conftest import clean_environment


def test_the_instance_lies_in_the_home_where_none_is_named(repo: Path, tmp_path: Path) -> None:
    environment = clean_environment() | {"NVSF_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "pipelines.instance"]
    subprocess.run(command, cwd=repo, env=environment, check=True)
    assert (tmp_path / "dagster" / TEMPLATE).is_file()


def test_two_first_runs_at_once_make_one_instance(repo: Path, tmp_path: Path) -> None:
    place = tmp_path / "home/dagster"
    environment = clean_environment() | {"DAGSTER_HOME": str(place)}
    command = [sys.executable, "-m", "pipelines.instance"]
    both = [
        subprocess.Popen(command, cwd=repo, env=environment, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [one.communicate(timeout=200)[1] for one in both]
    assert [one.returncode for one in both] == [0, 0], said
    assert (place / "history/runs.db").is_file()
    template = repo / "pipelines" / TEMPLATE
    assert (place / TEMPLATE).read_bytes() == template.read_bytes()
    assert not list(place.glob(".publishing-*"))
    (place / TEMPLATE).write_text("own")
    make_instance(place)
    assert (place / TEMPLATE).read_text() == "own"


def test_an_instance_that_cannot_be_made_is_one_line_and_leaves_no_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "dagster"
    place.mkdir()
    (place / "history").write_text("a file in the place of the tables' folder")
    with pytest.raises(StoreError, match="to make the instance's tables, found exit status"):
        make_instance(place)
    assert not (place / TEMPLATE).exists()
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DAGSTER_HOME", str(place / "history/below"))
    said = CliRunner().invoke(main, ["train"])
    assert said.exit_code == 1 and said.output.startswith("Error: DAGSTER_HOME="), said.output


@pytest.mark.cli
def test_the_command_trains_in_a_folder_that_has_modules_of_the_same_names(
    repo: Path, tiny_catalogue: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own"
    (own / "pipelines").mkdir(parents=True)
    (own / "pipelines/__init__.py").touch()
    (own / "assets.py").write_text("raise SystemExit('the user's own')")
    environment = clean_environment() | {
        "PYTHONPATH": str(repo), "NVSF_SCENES": str(tiny_catalogue), "NVSF_EXECUTOR": "in_process",
        "SCENES": "absent", "DAGSTER_DISABLE_TELEMETRY": "1",
    }  # fmt: skip
    done = subprocess.run(
        [Path(sys.executable).with_name("nvsf"), "train"],
        cwd=own, env=environment, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 1 and "FAILED  absent: drive: no data at" in done.stdout, done.stderr
    assert (own / ".nvsf/benchmark_report/index.html").is_file()
