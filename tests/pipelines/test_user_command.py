"""The user's own command on the tiny drive, and what may follow it."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import dagster as dg
import pytest

from nvsf_core.stages import STAGES, find_scene, plan_run, run_named_stage, run_scene
from nvsf_core.stages.runner.stage import Task
from nvsf_core.stages.sizes import dataset_bytes, novel_views_bytes
from nvsf_core.stages.versions import damage_of_version, make_anew, versions_of
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.schemas import CONTRACT, violations
from tests.hostile import harm

pytestmark = pytest.mark.cli
COMMAND = ("dagster", "job", "execute", "-j", "train_all_scenes")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def first_run(run_process, tiny_catalogue, home):
    return run_process(
        *COMMAND, DAGSTER_MODULE_NAME="pipelines.definitions", NVSF_SCENES=str(tiny_catalogue),
        NVSF_HOME=str(home), NVSF_LOG_FILE=str(home / "log.jsonl"),
    )  # fmt: skip


@pytest.fixture
def trained(first_run, tiny_catalogue, home, monkeypatch):
    """The home of the first run; what changes a data set of it works on a copy."""
    assert first_run.returncode == 0, first_run.stdout + first_run.stderr
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    monkeypatch.setenv("NVSF_HOME", str(home))
    return home


def test_the_bare_command_trains_and_prints_table_report_and_scans(first_run, home):
    assert first_run.returncode == 0, first_run.stdout + first_run.stderr
    for method in ("smoke", "reproject", "copy_nearest"):
        assert method in first_run.stdout
    assert f"report  {home / 'benchmark_report/index.html'}" in first_run.stdout
    assert "no data: absent" in first_run.stdout
    for view in ("test", "shift_1m"):
        (version,) = (home / "tiny/dataset" / view).iterdir()
        assert f"scans  {version}" in first_run.stdout
        assert list((version / "velodyne_points/data").glob("*.bin"))


def test_the_report_links_to_the_data_sets_and_shows_no_scene_of_another_home(first_run, home):
    page = (home / "benchmark_report/index.html").read_text()
    for view in ("test", "shift_1m"):
        (version,) = (home / "tiny/dataset" / view).iterdir()
        link = f"../tiny/dataset/{view}/{version.name}/"
        assert f'href="{link}"' in page and (home / "benchmark_report" / link).resolve() == version.resolve()
    assert 'id="speed"' not in page and "k360_street" not in page


def test_without_the_variable_the_command_says_what_is_missing(run_process, tiny_catalogue):
    done = run_process(*COMMAND, NVSF_SCENES=str(tiny_catalogue))
    assert done.returncode == 2 and "Invalid set of CLI arguments" in done.stderr


def test_what_was_published_keeps_the_data_contract(trained):
    for spec in CONTRACT:
        if spec.kind == "zarr":
            path = spec.path.replace("<recipe>", "smoke").replace("<seed>", "0")
            # Of the held-out view the recording is the truth.
            view = "shift_1m" if path.endswith("truth.zarr") else "test"
            path = path.replace("<view>", view).replace("<method>", "model")
            assert violations(spec, read_arrays(trained / "tiny" / path)) == [], path


def test_what_a_data_set_takes_on_the_disk_is_estimated_from_its_view(trained):
    run = plan_run(find_scene("tiny"), trained)
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=trained, progress=str)
    written = sum(file.stat().st_size for file in (trained / "tiny/dataset").glob("*/manual-*/*/**/*.*"))
    assert written < dataset_bytes(task) < 3 * written


@pytest.mark.parametrize("name", ["sweeps", "pano", "undistorted", "evidence", "field", "mesh"])
def test_what_a_stage_takes_on_the_disk_is_not_more_than_estimated(trained, name):
    run, stage = plan_run(find_scene("tiny"), trained), next(one for one in STAGES if one.name == name)
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=trained, progress=str)
    files = run.store.path(stage.location(run.config)).rglob("*")
    chunks = sum(file.stat().st_size for file in files if file.is_file() and file.suffix != ".json")
    # Range images of so few lasers are nearly empty, which packs well. Beside a model lies its checkpoint:
    # weights, their mean and their two moments, four times as much.
    empty = 4 * (66 + 64) * 1030 * 8 if name == "pano" else 0
    most = 7 if name == "field" else 6
    assert chunks < stage.estimate_bytes(task) < 2_000_000 + empty + most * chunks


def test_what_rendered_views_take_on_the_disk_is_estimated_from_the_drive(trained):
    run = plan_run(find_scene("tiny"), trained)
    task = Task(scene=run.scene, store=run.store, config=run.config, folder=trained, progress=str)
    views = trained / "tiny/novel_views/smoke/0"
    written = sum(file.stat().st_size for file in views.rglob("*") if file.is_file() and file.parent != views)
    # Of so few lasers range images are nearly empty, which packs well: two views by four methods.
    panos = 2 * 4 * 66 * 1030 * 12
    assert written < novel_views_bytes(task) < 3 * written + panos
    longer = replace(run.scene, views=tuple(replace(view, frames=(1, 3)) for view in run.scene.views))
    more = novel_views_bytes(replace(task, scene=longer)) - novel_views_bytes(task)
    assert more == novel_views_bytes(replace(task, scene=replace(longer, test_frames=()))) // 2


@pytest.fixture(scope="module")
def instance_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("instance")
    shutil.copy("pipelines/dagster.yaml", folder)
    return folder


@pytest.fixture(scope="module")
def second_run(run_process, first_run, tiny_catalogue, home, instance_folder):
    return run_process(
        "dg", "launch", "--job", "train_all_scenes", NVSF_SCENES=str(tiny_catalogue), NVSF_HOME=str(home),
        NVSF_EXECUTOR="in_process", DAGSTER_HOME=str(instance_folder),
    )  # fmt: skip


def test_a_second_run_by_dg_launch_bare_skips_every_stage(second_run):
    assert second_run.returncode == 0, second_run.stdout + second_run.stderr
    assert second_run.stderr.count("up to date, skipped") == 10


def test_a_run_of_the_terminal_is_of_the_code_location_and_registers_its_scenes(
    second_run, home, instance_folder
):
    with dg.DagsterInstance.from_config(str(instance_folder)) as instance:
        (run,) = instance.get_runs(dg.RunsFilter(tags={".dagster/repository": "__repository__@nvsf"}))
        assert run.remote_job_origin.location_name == "nvsf" and run.tags["nvsf/started_by"] == "terminal"
        assert run.status is dg.DagsterRunStatus.SUCCESS, second_run.stderr
        assert instance.get_dynamic_partitions("scenes") == ["tiny"]
        made = instance.get_latest_materialization_event(dg.AssetKey(["nvsf", "dataset"]))
        metadata = made.asset_materialization.metadata
    first, test, shifted = (metadata[name].value for name in ("path", "path_test", "path_shift_1m"))
    data_sets = home / "tiny/dataset"
    assert first == test and Path(test).parent == data_sets / "test"
    assert Path(shifted).parent == data_sets / "shift_1m" and (Path(shifted) / "manifest.json").is_file()


def test_a_trained_home_and_its_drive_are_up_to_date_elsewhere(trained, tiny_catalogue, tmp_path):
    shutil.copytree(trained, tmp_path / "home", copy_function=shutil.copy)  # other times and inodes
    shutil.copytree(tiny_catalogue.parent / "drive", tmp_path / "drive", copy_function=shutil.copy)
    scene = replace(find_scene("tiny"), root=tmp_path / "drive")
    assert [one.stage for one in run_scene(scene, tmp_path / "home", progress=str) if not one.skipped] == []


WEEKLY_TICK = """
import datetime, json
import dagster as dg
from pipelines.definitions import defs
from pipelines.schedules import weekly_regeneration

moment = datetime.datetime(2026, 11, 22, 3, tzinfo=datetime.UTC)
repository = defs.get_repository_def()
with dg.instance_for_test() as instance:
    context = dg.build_schedule_context(
        instance=instance, scheduled_execution_time=moment, repository_def=repository
    )
    (request,) = weekly_regeneration.evaluate_tick(context).run_requests
    result = defs.resolve_job_def("regenerate_synthetic").execute_in_process(
        partition_key=request.partition_key, run_config=request.run_config, instance=instance
    )
    # A daemon that died within the tick evaluates it again: Dagster launches a run key once.
    (again,) = weekly_regeneration.evaluate_tick(context).run_requests
assert again == request
print(json.dumps([request.partition_key, request.run_key, request.run_config["resources"], result.success]))
"""


@pytest.fixture(scope="module")
def weekly(run_process, first_run, tiny_catalogue, home, tmp_path_factory):
    """A copy of the home after a weekly tick, and what the tick has said."""
    copy = tmp_path_factory.mktemp("weekly") / "home"
    shutil.copytree(home, copy)
    return copy, run_process(
        sys.executable, "-c", WEEKLY_TICK, NVSF_SCENES=str(tiny_catalogue), NVSF_HOME=str(copy)
    )


def test_a_weekly_tick_makes_a_new_version_beside_the_old_one(weekly, trained):
    home, done = weekly
    before = _versions(trained)
    assert done.returncode == 0, done.stdout + done.stderr
    partition, key, resources, success = json.loads(done.stdout.splitlines()[-1])
    assert (partition, key, success) == ("tiny", "tiny-2026-W47", True)
    choice = {"recipe": "smoke", "seed": 0, "draw_seed": 202647, "dataset_label": "2026-W47"}
    assert resources == {"workspace": {"config": choice}}
    new = _versions(home) - before
    assert before < before | new and {place.partition("-W47-")[0] for place in new} == {
        "shift_1m/2026", "test/2026",
    }  # fmt: skip
    assert len(new) == 2, "the next version of each view"
    assert "field: up to date, skipped" in done.stderr


def _versions(home):
    folder = home / "tiny/dataset"
    return {path.relative_to(folder).as_posix() for path in folder.glob("[!.]*/*")}


def _data_sets(home):
    found = (home / "tiny" / "dataset").glob("[!.]*/*/**/*")
    return {path: path.read_bytes() for path in found if path.is_file()}


def test_a_whole_version_is_not_written_again(trained):
    before = {path: path.stat().st_ino for path in _data_sets(trained)}
    # As after a kill before the index was published.
    (trained / "tiny/dataset/.index/smoke/0-0-manual/stage.json").unlink()
    assert not run_named_stage("dataset", plan_run(find_scene("tiny"), trained), str).skipped
    assert {path: path.stat().st_ino for path in before} == before


def _other_seed(manifest):
    manifest.write_text(manifest.read_text().replace('"seed": 0', '"seed": 1', 1))


def test_a_damaged_file_of_any_version_is_found_and_made_anew(
    run_process, weekly, tiny_catalogue, monkeypatch
):
    home, _ = weekly
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    before = _data_sets(home)
    scan, manifest = (next(path for path in before if path.name.endswith(end) and "W47" in str(path))
                      for end in (".bin", "manifest.json"))  # fmt: skip
    for path, done_to in ((manifest, _other_seed), (scan, os.unlink), (scan, harm.flip)):
        done_to(path)
        (damaged,) = [one for one in versions_of(SceneStore(home, "tiny")) if damage_of_version(one)]
        assert damage_of_version(damaged) == str(path)
        if done_to is not harm.flip:
            assert make_anew(find_scene("tiny"), home, damaged, str)
    done = run_process(
        "nvsf", "verify", "tiny", "--mend", NVSF_SCENES=str(tiny_catalogue), NVSF_HOME=str(home)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("made anew") == 1 and done.stdout.count("whole") == 3, done.stdout
    assert _data_sets(home) == before, "byte for byte"


def test_logs_as_json_lines_say_scene_stage_and_run(first_run, home):
    lines = [json.loads(line) for line in (home / "log.jsonl").read_text().splitlines()]
    (done,) = [line for line in lines if line.get("stage") == "field" and "seconds" in line]
    assert (done["scene"], done["partition"], done["level"]) == ("tiny", "tiny", "info")
    assert done["job"] == "train_all_scenes" and done["step"].startswith("field_of_scene")
    assert done["peak_memory_mb"] > 100.0 and {"read_mb", "written_mb", "run_id", "time"} <= done.keys()
