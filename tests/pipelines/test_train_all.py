"""One scene's failure is its own: on a tiny flow of two stages."""

import json
import os
import sys

import dagster as dg
import pytest
from dagster._core.definitions.data_version import CachingStaleStatusResolver
from dagster._core.loader import LoadingContextForTest

from assets.report import benchmark_report, write_benchmark_report
from assets.scenes import DATA_VERSION, SCENES, key_of
from assets.verdicts import CHECK_NAME
from assets.workspace import Workspace
from nvsf_core.errors import DataError
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.stages.runner.stage import Check, Stage, StageOutput
from nvsf_core.stores.tables import write_rows
from pipelines.definitions import defs
from pipelines.failures import COMMAND_VARIABLE
from pipelines.passed_values import RUNS
from pipelines.train_all import make_train_all_scenes

CATALOGUE = """
[[scene]]
name = "good"
root = "drive"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = 3
test_frames = [2]

[[scene]]
name = "bad"
root = "drive"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = 2
test_frames = [1]

[[scene]]
name = "gone"
root = "nowhere"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = 1
test_frames = [1]
"""

TORN = ("bad",)
"""Scenes whose drive cannot be read."""


def _ingest(task):
    if task.scene.name in TORN:
        raise DataError("the scan is torn")
    (task.folder / "rows").write_text("1")
    named = Check(name="rows_are_whole", passed=True, detail="1 row", blocking=True)
    return StageOutput(metadata={"rows": 1}, checks=[named])


def _measure(task):
    write_rows(task.folder / "metrics.parquet", [], COLUMNS)
    return StageOutput()


FLOW = (
    Stage(name="frames", group="ingest", inputs=(), description="rows", version="1", run=_ingest),
    Stage(
        name="scene_metrics", group="report", inputs=("frames",), description="no metrics", version="1",
        run=_measure, per_recipe=True,
    ),
)  # fmt: skip


@pytest.fixture
def instance():
    with dg.DagsterInstance.ephemeral() as made:
        yield made


@pytest.fixture
def run_job(tiny_catalogue, tmp_path, monkeypatch, capsys, instance):
    catalogue = tmp_path / "scenes.toml"
    catalogue.write_text(CATALOGUE.replace('"drive"', f'"{tiny_catalogue.parent / "drive"}"'))
    monkeypatch.setenv("NVSF_SCENES", str(catalogue))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))

    def run(*scenes):
        job = make_train_all_scenes(FLOW)
        result = job.execute_in_process(
            run_config={"ops": {"choose_scenes": {"config": {"scenes": list(scenes)}}}},
            instance=instance, raise_on_error=False,
        )  # fmt: skip
        return result, capsys.readouterr().out

    return run


def _events(result, kind):
    return [event for event in result.all_events if event.event_type_value == kind]


def test_a_failing_scene_leaves_the_others_and_fails_the_run(run_job, tmp_path):
    result, said = run_job()
    assert not result.success
    events = _events(result, "ASSET_MATERIALIZATION")
    made = {(event.asset_key.path[-1], event.partition) for event in events}
    assert made == {("frames", "good"), ("scene_metrics", "good"), ("benchmark_report", None)}
    assert "FAILED  bad: frames: the scan is torn" in said
    assert (tmp_path / "home/benchmark_report/index.html").is_file()
    assert result.failure_data_for_node("fail_if_any_failed").error.message.count("bad") == 1


def test_the_event_of_the_report_has_what_the_report_s_own_asset_says_of_it(run_job, instance):
    result, _ = run_job("good")
    made = dg.materialize([benchmark_report], instance=instance, resources={"workspace": Workspace()})
    (by_job,) = [
        one.event_specific_data.materialization.metadata
        for one in _events(result, "ASSET_MATERIALIZATION")
        if one.asset_key == key_of("benchmark_report")
    ]
    (by_asset,) = made.asset_materializations_for_node("nvsf__benchmark_report")
    assert by_job == by_asset.metadata
    assert (by_job["scenes"].value, by_job["scenes_without_data"].value) == (1, 1)


def test_a_failed_scene_has_a_failed_check(run_job):
    result, _ = run_job()
    verdicts = [event.asset_check_evaluation_data for event in _events(result, "ASSET_CHECK_EVALUATION")]
    assert [one.description for one in verdicts if not one.passed] == ["scene bad: frames: the scan is torn"]


def test_a_failed_scene_s_partition_is_failed_at_its_stage_until_it_succeeds(run_job, instance, monkeypatch):
    def states():
        found = {}
        for stage in ("frames", "scene_metrics"):
            of = instance.get_status_by_partition(key_of(stage), ["good", "bad"], SCENES)
            found[stage] = [one and one.value for one in of.values()]
        return found

    run_job("good", "bad")
    assert states() == {"frames": ["MATERIALIZED", "FAILED"], "scene_metrics": ["MATERIALIZED", None]}
    monkeypatch.setattr(sys.modules[__name__], "TORN", ())
    run_job("bad")
    assert states() == {"frames": ["MATERIALIZED"] * 2, "scene_metrics": ["MATERIALIZED"] * 2}


def test_a_report_is_not_out_of_date_for_what_a_failed_scene_never_made(run_job, instance):
    def state():
        graph = defs.get_repository_def().asset_graph
        found = CachingStaleStatusResolver(instance, graph, LoadingContextForTest(instance))
        return found.get_status(key_of("benchmark_report")).value

    run_job("good", "bad")
    assert state() == "FRESH"
    instance.report_runless_asset_event(
        dg.AssetMaterialization(key_of("scene_metrics"), partition="bad", tags={DATA_VERSION: "1"})
    )
    assert state() == "STALE"


def test_a_scene_s_failure_stays_in_the_report_until_it_succeeds(run_job, tmp_path, monkeypatch):
    run_job("good", "bad")
    page = tmp_path / "home/benchmark_report/index.html"
    run_job("good")
    assert "<b>bad failed:</b><pre>frames: the scan is torn (" in page.read_text()
    write_benchmark_report(tmp_path / "home", [])
    assert "the scan is torn" in page.read_text()
    monkeypatch.setattr(sys.modules[__name__], "TORN", ())
    run_job("bad")
    assert "the scan is torn" not in page.read_text()


def test_a_failed_run_says_nothing_of_a_command_that_nobody_named(run_job, instance):
    result, _ = run_job("bad")
    said = [one.user_message for one in instance.all_logs(result.run_id)]
    assert "[bad] FAILED in frames: the scan is torn" in said
    assert not any(COMMAND_VARIABLE in one for one in said)


def test_a_failed_run_without_a_daemon_calls_the_users_command(run_job, monkeypatch, tmp_path):
    monkeypatch.setenv(COMMAND_VARIABLE, f"tee {tmp_path / 'told.json'}")
    run_job("good")
    assert not (tmp_path / "told.json").exists()
    run_job()
    told = json.loads((tmp_path / "told.json").read_text())
    assert (told["job"], told["words"]) == ("train_all_scenes", "bad: frames: the scan is torn")


def test_each_scene_s_verdict_is_of_its_newest_output_so_that_the_ui_shows_it(run_job, instance):
    run_job("good", "bad")
    run_job("good")
    key = dg.AssetCheckKey(key_of("frames"), CHECK_NAME)
    found = instance.event_log_storage.get_asset_check_partition_info([key])
    said = {one.partition_key: (one.latest_execution_status.value, one.is_current) for one in found}
    assert said == {"good": ("SUCCEEDED", True), "bad": ("FAILED", True)}


def test_a_scene_without_data_is_named_and_no_failure(run_job):
    result, said = run_job("good")
    assert result.success and "gone" not in said
    result, said = run_job()
    assert "no data: gone" in said and "FAILED  gone" not in said


def test_a_scene_asked_for_by_name_without_data_fails(run_job):
    result, said = run_job("good", "gone")
    assert not result.success
    assert "FAILED  gone: drive: no data at" in said and "good: " in said


@pytest.mark.parametrize(
    ("name", "hint"), [("GOOD", "did you mean good?"), ("../x", "it has good"), ("good,bad", "by blanks")]
)
def test_a_name_that_the_catalogue_has_not_is_refused_before_any_scene_is_begun(run_job, name, hint):
    result, _ = run_job("bad", name)
    message = result.failure_data_for_node("choose_scenes").error.message
    assert f"no scene '{name}' in the catalogue" in message and hint in message
    assert not _events(result, "ASSET_CHECK_EVALUATION")


def test_the_second_run_skips_and_says_so(run_job):
    run_job("good")
    result, said = run_job("good")
    assert result.success and "2 stages, up to date" in said


def test_what_steps_pass_on_lies_in_the_shared_home_as_json_and_goes_after_a_month(run_job, tmp_path):
    first, _ = run_job("good")
    runs = tmp_path / "home" / RUNS
    passed = {path.relative_to(runs / first.run_id).as_posix(): path for path in runs.rglob("*.json")}
    state = json.loads(passed["frames_of_scene[good]/result.json"].read_text())["value"]
    assert state["scene"] == "good" and [one["stage"] for one in state["stages"]] == ["frames"]
    assert {"choose_scenes/scene/good.json", "choose_scenes/absent.json", "report_all/result.json"} <= set(
        passed
    )
    os.utime(runs / first.run_id, (1e9, 1e9))
    second, _ = run_job("good")
    assert [folder.name for folder in runs.iterdir()] == [second.run_id]


def test_scenes_may_come_from_the_environment(run_job, monkeypatch):
    monkeypatch.setenv("SCENES", "good")
    result, said = run_job()
    assert result.success and "[bad]" not in said
