"""The command `nvsf` says what there is, what is missing, and what went wrong in one line."""

import os
import resource
import shutil
import subprocess
from collections.abc import Iterator

import dagster as dg
import pytest
from click.testing import CliRunner

from nvsf_core.demo.drive import DemoSize, write_demo
from nvsf_core.drives.catalogue import load_catalogue
from pipelines.cli import main
from pipelines.doctor.findings import examine
from pipelines.doctor.instance import examine_instance
from pipelines.reaper import host_tags


@pytest.fixture
def ask(tiny_catalogue, tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    return lambda *words: CliRunner().invoke(main, words)


def test_its_commands_are_listed(ask):
    said = ask("--help")
    assert said.exit_code == 0
    for command in ("demo", "train", "view", "report", "scenes", "verify", "weights", "doctor"):
        assert f"  {command} " in said.output


def test_views_are_checked_at_once(ask):
    said = ask("view", "--check")
    assert (
        said.exit_code == 0 and "tiny, shift_1m: 1 instants, 0.1 to 0.1 s on the recorded path" in said.output
    )
    own = ask("view", "tiny", "rate_hz = 20", 'sensor = "VLS-128"', "--check")
    assert own.output.startswith("tiny, view: 7 instants, 0 to 0.3 s"), own.output
    for keys, words in (
        ("times_s = [9.5]", "expected times from 0 to 0.3 seconds of the drive, found [9.5]"),
        ("frames = [1.5]", "moments between frames are `times_s`"),
        ("speed = 5", "a sweep goes on for 0.5 s of the recorded path: expected times from 0.15 to 0.15"),
        ("frozen_at_s = 7", "frozen_at_s: expected 0 to 0.3"),
        (
            'waypoints = [{ time_s = 0.1, position_m = [0.0, 0.0, 0.0] }]\npath_in = "world"',
            "expected a path within 1000 m of the drive",
        ),
        ('cameras = ["image_01"]', "expected cameras that the drive has, found image_01"),
    ):
        wrong = ask("view", "tiny", keys, "--check")
        assert wrong.exit_code == 1 and words in wrong.output, wrong.output


def test_a_check_names_a_path_on_which_the_lidar_stands_on_its_head(ask, tmp_path):
    for order, turned in (("0 0 0 1", False), ("1 0 0 0", True)):
        path = tmp_path / "path.txt"
        path.write_text(f"0.1 0 0 0 {order}\n0.2 1 0 0 {order}\n")
        said = ask("view", "tiny", f'pose_file = "{path}"', "--check")
        assert said.exit_code == 0 and said.output.startswith("tiny, view: "), said.output
        assert ("the LiDAR is up to 180 degrees off upright" in said.output) is turned


def test_a_check_says_where_no_view_is_asked_for(ask, tiny_catalogue, tmp_path, monkeypatch):
    text = tiny_catalogue.read_text().replace('"drive"', f'"{tiny_catalogue.parent / "drive"}"')
    (tmp_path / "none.toml").write_text(text.split("[[view]]")[0].split("[[scene.view]]")[0])
    monkeypatch.setenv("NVSF_SCENES", str(tmp_path / "none.toml"))
    said = ask("view", "tiny", "--check")
    assert said.exit_code == 0 and said.output.startswith("tiny, no view is asked for"), said.output


def test_a_check_names_true_images_and_drives_that_are_absent(ask, tiny_catalogue, tmp_path, monkeypatch):
    assert "\nnot checked, no data here: absent" in ask("view", "--check").output
    said = ask("view", "absent", "--check")
    assert said.exit_code == 1 and "absent: not checked, no data at " in said.output, said.output
    text = tiny_catalogue.read_text().replace('"drive"', f'"{tiny_catalogue.parent / "drive"}"')
    (tmp_path / "truth.toml").write_text(f'{text}truth = {{ image_00 = "true" }}\n')
    monkeypatch.setenv("NVSF_SCENES", str(tmp_path / "truth.toml"))
    said = ask("view", "tiny", "--check")
    assert said.exit_code == 1 and "truth of image_00: expected a folder of images at" in said.output


@pytest.mark.parametrize(
    ("name", "value"),
    [("NVSF_EXECUTOR", "dask"), ("NVSF_THREADS", "many"), ("NVSF_QUIET_S", "soon"), ("NVSF_QUIET_S", "-1"),
     ("NVSF_QUIET_S", "nan")],
)  # fmt: skip
def test_the_doctor_names_variables_that_no_run_would_take(ask, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    said = ask("doctor")
    assert said.exit_code == 1 and f": {name}={value!r}: expected " in said.output, said.output


def test_a_view_of_the_command_line_may_ask_for_a_sensor_of_the_catalogue(
    ask, tiny_catalogue, tmp_path, monkeypatch
):
    own = tmp_path / "own.toml"
    own.write_text('[[sensor]]\nname = "mine"\nelevation_deg = [2.0, -3.0]\n')
    monkeypatch.setenv("NVSF_SCENES", f"{tiny_catalogue}:{own}")
    said = ask("view", "tiny", 'sensor = "mine"', "--check")
    assert said.exit_code == 0 and "LiDAR mine" in said.output, said.output
    refused = ask("view", "tiny", 'sensor = "yours"', "--check")
    assert refused.exit_code == 1 and "sensor: expected one of HDL-64E" in refused.output


def test_what_is_trained_is_said_by_arguments_else_by_the_environment(ask, monkeypatch):
    def chosen(*words):
        return main.commands["train"].make_context("train", list(words)).params

    assert chosen() == {"scenes": (), "recipe": "", "seed": 0}
    for name, value in (("SCENES", "tiny absent"), ("RECIPE", "smoke"), ("SEED", "7")):
        monkeypatch.setenv(name, value)
    assert chosen() == {"scenes": ("tiny", "absent"), "recipe": "smoke", "seed": 7}
    own = chosen("other", "--recipe", "quick", "--seed", "0")
    assert own == {"scenes": ("other",), "recipe": "quick", "seed": 0}
    monkeypatch.setenv("SEED", "seven")
    said = ask("view", "tiny")
    assert said.exit_code == 2 and "env var: 'SEED'" in said.output, said.output
    for name, value in (("SCENES", ""), ("RECIPE", "misspelt"), ("SEED", "")):  # empty is unset, as of `make`
        monkeypatch.setenv(name, value)
    assert chosen()["scenes"] == () and chosen()["seed"] == 0
    said = ask("view", "tiny")
    assert said.exit_code == 1 and "misspelt" in said.output, said.output


def test_scenes_are_listed_with_what_is_there(ask):
    said = ask("scenes").output.splitlines()
    assert any(line.startswith("tiny ") and line.endswith("not trained") for line in said)
    assert any(line.startswith("absent ") and "no data at " in line for line in said)


def test_the_doctor_looks_at_everything_and_nothing_that_is_needed_is_missing_here(ask):
    said = ask("doctor")
    subjects = {finding.subject for finding in examine(os.environ)}
    assert said.exit_code == 0, said.output
    assert {
        "machine", "threads", "kernels", "GPU", "NVSF_HOME", "locks", "catalogue", "data sets", "automation",
        "open3d", "LPIPS weights", "executors", "Dagster instance",
    } == subjects  # fmt: skip
    assert all(f" {subject}: " in said.output for subject in subjects)
    assert "`python -m pipelines.instance` make it, the bare `dagster` does not" in said.output
    assert not (list(os.scandir(os.environ["NVSF_HOME"])) if os.path.isdir(os.environ["NVSF_HOME"]) else [])


@pytest.mark.parametrize(
    ("template", "is_fine", "words"),
    [("pipelines/dagster.yaml", True, "no daemon runs"), (None, False, "lacks `run_retries: enabled: true`")],
)
def test_an_instance_s_settings_daemon_and_hanging_runs_are_examined(
    repo, tmp_path, monkeypatch, template, is_fine, words
):
    (tmp_path / "dagster.yaml").write_text((repo / template).read_text() if template else "")
    monkeypatch.setenv("DAGSTER_HOME", str(tmp_path))
    with dg.DagsterInstance.get() as instance:
        hanging = instance.create_run_for_job(waiting, status=dg.DagsterRunStatus.STARTED, tags=host_tags())
    fine, said = examine_instance(os.environ)
    assert not fine and f"processes are gone: {hanging.run_id[:8]}" in said
    with dg.DagsterInstance.get() as instance:
        instance.delete_run(hanging.run_id)
    fine, said = examine_instance(os.environ)
    assert fine is is_fine and words in said


@dg.job
def waiting():
    pass


def test_a_catalogue_that_cannot_be_read_is_what_the_doctor_says(ask, monkeypatch, tmp_path):
    monkeypatch.setenv("NVSF_SCENES", str(tmp_path / "nowhere.toml"))
    said = ask("doctor")
    assert said.exit_code == 1 and "MISSING catalogue: " in said.output


def test_an_unknown_scene_is_not_trained_and_nothing_is_made(ask, tmp_path):
    said = ask("train", "Tiny", "tiny")
    assert said.exit_code == 1 and "did you mean tiny?" in said.output, said.output
    assert not (tmp_path / "home").exists()


def test_an_unknown_scene_is_one_line(ask):
    said = ask("view", "nobody")
    assert said.exit_code == 1 and "no scene 'nobody'" in said.output and "Traceback" not in said.output


def test_the_report_is_made_of_what_is_there(ask):
    said = ask("report")
    assert said.exit_code == 0, said.output
    assert said.output.strip().endswith("home/benchmark_report/index.html")
    assert os.path.isfile(said.output.strip())


def test_a_recording_is_imported_and_what_is_left_out_is_named(ask, tiny_catalogue, tmp_path):
    drive = tmp_path / "drive"
    shutil.copytree(tiny_catalogue.parent / "drive", drive)
    (scan,) = drive.glob("data_3d_raw/*/velodyne_points/data/0000000001.bin")
    scan.write_bytes(b"cut")
    done = ask("import", str(drive), "--out", str(tmp_path / "mine"))
    assert done.exit_code == 0, done.output
    assert "scan 1: " in done.output and "truncated scan" in done.output
    assert "3 scans, 4 images, 4 poses of frames 0 to 3; 1 left out" in done.output
    again = ask("import", str(drive), "--out", str(tmp_path / "mine"))
    assert again.exit_code == 1 and "expected a folder to be made" in again.output
    nothing = ask("import", str(tmp_path / "nowhere"), "--out", str(tmp_path / "other"))
    assert nothing.exit_code == 1 and "found nothing" in nothing.output


def test_names_in_a_drive_neither_steer_the_terminal_nor_make_lines_of_their_own(ask, tmp_path):
    write_demo(tmp_path / "demo", size=DemoSize.tiny())
    assert ask("import", str(tmp_path / "demo"), "--out", str(tmp_path / "plain")).exit_code == 0
    camera = tmp_path / "plain/images/\x1b]0;pwned\x07\nError: all is lost"
    shutil.copytree(tmp_path / "plain/images/image_00", camera)
    done = ask("import", str(tmp_path / "plain"), "--out", str(tmp_path / "again"))
    assert done.exit_code == 0 and "\x1b" not in done.output, done.output
    assert r"\x1b]0;pwned\x07\nError: all is lost left out: no entry in cameras.json" in done.output
    nowhere = ask("import", str(tmp_path / "no\x1b[2Jwhere"), "--out", str(tmp_path / "other"))
    assert nowhere.exit_code == 1 and r"no\x1b[2Jwhere: expected a recording" in nowhere.output


def test_what_an_import_says_to_set_is_taken_by_a_shell_whatever_the_folder_s_name(ask, tmp_path):
    write_demo(tmp_path / "drive", size=DemoSize.tiny())
    out = tmp_path / "my first drive"
    done = ask("import", str(tmp_path / "drive"), "--out", str(out), "--name", "first")
    assert done.exit_code == 0, done.output
    assert [entry.name for entry in load_catalogue([out / "scenes.toml"], None)] == ["first"]
    export = done.output[done.output.index("export ") :]
    said = subprocess.run(
        ["sh", "-c", f'{export}\nprintf %s "$NVSF_SCENES"'], capture_output=True, text=True, check=True
    )
    assert said.stdout == str(tmp_path / "my first drive/scenes.toml")


def test_a_scene_whose_root_cannot_be_looked_into_stops_no_other(ask, tiny_catalogue, tmp_path, monkeypatch):
    own = tmp_path / "own.toml"
    own.write_text(
        f'[[scene]]\nname = "hidden"\nroot = "/{"r" * 300}"\nsequence = "2013_05_28_drive_0001_sync"\n'
        "first_frame = 0\nlast_frame = 3\ntest_frames = []\n"
    )
    monkeypatch.setenv("NVSF_SCENES", f"{own}:{tiny_catalogue}")
    said = ask("scenes")
    assert said.exit_code == 0 and "cannot look into" in said.output and "\ntiny " in said.output, said.output
    said = ask("doctor").output
    assert "scene hidden: cannot look into" in said and "with data here: tiny" in said
    assert ask("report").exit_code == 0


def test_a_scene_that_may_not_be_entered_is_named_and_the_others_are_listed(ask, tmp_path):
    closed = tmp_path / "home" / "tiny"
    (closed / "field").mkdir(parents=True)
    closed.chmod(0)
    try:
        if os.access(closed, os.X_OK):
            pytest.skip("this user, as root, may enter what nobody may")
        said = ask("scenes")
    finally:
        closed.chmod(0o700)
    assert said.exit_code == 0, said.output
    assert f"cannot use {closed / 'field'} (Permission denied); correct its owner" in said.output


def test_the_doctor_goes_on_where_folders_may_not_be_entered(tiny_catalogue, tmp_path):
    closed = tmp_path / "closed"
    (closed / "home").mkdir(parents=True)
    closed.chmod(0)
    place = str(closed / "home")
    try:
        if os.access(closed, os.X_OK):
            pytest.skip("this user, as root, may enter what nobody may")
        found = examine({"NVSF_HOME": place, "DAGSTER_HOME": place, "NVSF_SCENES": str(tiny_catalogue)})
    finally:
        closed.chmod(0o700)
    words = {one.subject: one.words for one in found if not one.is_fine}
    assert all("ermission denied" in words[name] for name in ("NVSF_HOME", "locks", "Dagster instance")), (
        words
    )


@pytest.fixture
def full_disk() -> Iterator[None]:
    """No file may be longer than a byte, which a process is refused as it is by a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_home_that_takes_no_file_ends_every_command_in_one_line(ask, tmp_path, full_disk):
    for words in (["train", "tiny"], ["view", "tiny", "frames = [1]"]):
        said = ask(*words)
        assert (said.exit_code, type(said.exception)) == (1, SystemExit), said.exception
        last = said.output.splitlines()[-1]
        assert last.startswith(f"Error: NVSF_HOME={tmp_path}/home: ") and "File too large" in last
    said = ask("doctor")
    assert said.exit_code == 1 and "MISSING NVSF_HOME: " in said.output


def test_a_name_that_the_disk_refuses_is_told_in_one_line(ask, tiny_catalogue, tmp_path):
    out = tmp_path / ("n" * 300)
    said = ask("import", str(tiny_catalogue.parent / "drive"), "--out", str(out))
    assert (said.exit_code, type(said.exception)) == (1, SystemExit), said.exception
    assert said.output == f"Error: cannot use {out} (File name too long); check space and name\n"
