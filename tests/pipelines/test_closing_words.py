"""What a run says to type is taken by a new shell in any folder, for the training that was asked for."""

import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner
from dagster._core.workspace.load import location_origins_from_yaml_paths

from assets.origin import LOCATION, MODULE
from nvsf_core.stages import find_scene, plan_run
from nvsf_core.stages.runner.record import RECORD_NAME
from nvsf_core.stores.documents import write_document
from pipelines.cli import _chosen, main
from pipelines.closing_words import _workspace, closing_words, next_ui, next_view
from tests.records import record_of_output


@pytest.fixture
def home(tiny_catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NVSF_HOME", "my home")
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    return tmp_path / "my home"


def _train(home: Path, scene: str, recipe: str, seed: int, made_s: float) -> None:
    folder = home / scene / "field" / recipe / str(seed)
    folder.mkdir(parents=True)
    write_document(folder / RECORD_NAME, record_of_output(made_s=made_s))


def test_a_view_is_of_the_newest_field_unless_another_training_is_asked_for(home: Path) -> None:
    assert _chosen("tiny", None, None) == ("tiny", {"recipe": None, "seed": 0})
    assert "nothing is trained yet" in CliRunner().invoke(main, ["view"]).output
    for scene, recipe, seed, made_s in (("tiny", "smoke", 3, 1e9), ("absent", "lean", 1, 3e9)):
        _train(home, scene, recipe, seed, made_s)
    _train(home, "tiny", "quick", 2, 2e9)
    assert _chosen(None, None, None) == ("absent", {"recipe": "lean", "seed": 1})
    assert _chosen("tiny", None, None)[1] == {"recipe": "quick", "seed": 2}
    assert _chosen("tiny", "smoke", None)[1] == {"recipe": "smoke", "seed": 3}
    assert _chosen("tiny", "smoke", 0)[1] == {"recipe": "smoke", "seed": 0}


def test_the_next_view_names_recipe_and_seed_where_the_newest_field_has_others(home: Path) -> None:
    _train(home, "tiny", "smoke", 3, 1e9)
    for seed, ends in ((3, "tiny 'shift_m = [0, 1, 0]'"), (4, "--recipe smoke --seed 4")):
        words = next_view(plan_run(find_scene("tiny"), home, recipe="smoke", seed=seed))
        assert words[-1].endswith(ends), words


def test_failed_checks_are_said_at_the_end_with_their_reason_in_the_terminal_s_width() -> None:
    state = {"scene": "tiny", "failed": "", "stages": [], "exports": []}
    sound = closing_words([], [{**state, "doubts": []}], {}, [], Path("r"))
    assert not any("doubt" in line for line in sound)
    path = f"/data/{'x' * 99}/scans/0000000004.bin"
    doubts = [f"all scans are usable: {k} scans left out: 4: {path}: no finite point" for k in range(6)]
    lines = closing_words([], [{**state, "doubts": doubts}], {}, [], Path("r"))
    said = [line for line in lines if line.startswith("  doubt  ")]
    assert len(said) == 4 and said[0].startswith("  doubt  all scans are usable: 0 scans left out: 4:")
    assert sum(line.endswith("no finite point") for line in lines) == 4
    assert lines[-2] == "  and 2 more: the report says what they found"
    assert max(map(len, lines)) <= 80
    endless = closing_words([], [{**state, "doubts": ["word " * 999]}], {}, [], Path("r"))
    assert len(endless) == 8 and endless[-2].endswith(" ...")


def test_a_failed_scene_is_neither_up_to_date_nor_unmeasured() -> None:
    state = {"scene": "bad", "failed": "field: torn", "exports": [], "doubts": [], "stages": []}
    at_once = closing_words([], [state], {"bad": "field: torn"}, [], Path("r"))
    assert at_once == ["", "FAILED  bad: field: torn", "report  r"]
    stages = [{"stage": "frames", "seconds": 3.0, "skipped": False}]
    later = closing_words([], [{**state, "stages": stages}], {"bad": "field: torn"}, [], Path("r"))
    assert later[1] == "bad: failed after 1 stages, 3 s"


def test_without_make_the_ui_s_code_location_is_the_one_that_runs_of_a_terminal_name(home: Path) -> None:
    *command, workspace = shlex.split(next_ui("1")[1])  # make takes no blanks, as in this home's path
    assert command[-6:-3] == ["env", "-u", "DAGSTER_MODULE_NAME"] and command[-2:] == ["dev", "-w"]
    (origin,) = location_origins_from_yaml_paths([workspace])
    assert origin.location_name == LOCATION and origin.loadable_target_origin.module_name == MODULE


def test_a_wheel_has_the_workspace_where_it_is_looked_for(repo: Path) -> None:
    built = tomllib.loads((repo / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    inside = built["force-include"]["workspace.yaml"]
    assert _workspace(Path("/site/pipelines")) == Path("/site") / inside


@pytest.mark.cli
def test_commands_to_go_on_with_run_in_a_new_shell_elsewhere(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said_by(command: str) -> str:
        done = subprocess.run(
            ["env", "-i", "PATH=/usr/bin:/bin", "sh", "-c", command], cwd="/", capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    command = next_view(plan_run(find_scene("tiny"), home, recipe="smoke"))[-1]
    assert said_by(f"{command} --check").startswith("tiny, view: ")
    monkeypatch.setenv("NVSF_HOME", "home")  # make takes no blanks
    monkeypatch.setenv("DAGSTER_HOME", "instance")
    started = said_by(next(line for line in next_ui("1") if "DAGSTER_HOME" in line) + " -n")
    assert "dagster dev" in started and f"{tmp_path / 'instance'}" in next_ui("1")[1]
