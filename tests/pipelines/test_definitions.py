"""What Dagster loads is the flow, and both ways of loading agree."""

import datetime

import dagster as dg
import pytest

from assets.offers import OFFERS
from assets.scenes import SCENES, key_of
from assets.verdicts import CHECK_NAME
from nvsf_core.errors import RecipeError
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.stages import STAGE_NAMES, STAGES
from pipelines.definitions import defs
from pipelines.executors import executor_from_environment
from pipelines.schedules import weekly_regeneration


def test_definitions_are_loadable():
    dg.Definitions.validate_loadable(defs)


def test_stages_are_in_an_order_that_has_every_input_first():
    for position, stage in enumerate(STAGES):
        assert stage.name == STAGE_NAMES[position]
        assert set(stage.inputs) <= set(STAGE_NAMES[:position])


def test_every_stage_is_an_asset_with_group_description_partitions_and_its_checks():
    graph = defs.resolve_asset_graph()
    observed = {"drive", "asked_views"}
    named = {key.to_user_string() for key in graph.get_all_asset_keys()}
    assert named == {f"nvsf/{name}" for name in (*STAGE_NAMES, *observed, "benchmark_report")}
    for stage in STAGES:
        node = graph.get(key_of(stage.name))
        parents = {key.path[-1] for key in node.parent_keys}
        assert parents - observed == set(stage.inputs) and ("drive" in parents) == stage.reads_drive
        assert node.group_name == stage.group and node.description and node.is_partitioned
        specs = [graph.get_check_spec(key) for key in graph.get_check_keys_for_assets({node.key})]
        expected = {CHECK_NAME: True} | {named.name: named.blocking for named in stage.named_checks}
        expected |= {OFFERS[stage.name][0]: False} if stage.name in OFFERS else {}
        assert {spec.name: spec.blocking for spec in specs} == expected
        offer = OFFERS[stage.name][0] if stage.name in OFFERS else None
        assert all(spec.description for spec in specs)
        assert all(spec.partitions_def == SCENES for spec in specs if spec.name != offer)
        assert node.owners and node.kinds and node.automation_condition
        assert (node.pools == {"device"}) == (stage.name == "field")
        assert node.backfill_policy == dg.BackfillPolicy.multi_run(max_partitions_per_run=1)
    assert {key.path[-1] for key in graph.get_all_asset_keys() if graph.get(key).freshness_policy} == {
        "dataset", "benchmark_report",
    }  # fmt: skip


def test_the_arrows_between_groups_run_one_way():
    graph = defs.resolve_asset_graph()
    order = ["drives", "ingest", "prepare", "train", "synthesis", "measure", "export", "report"]
    for key in graph.get_all_asset_keys():
        node = graph.get(key)
        for parent in node.parent_keys:
            assert order.index(graph.get(parent).group_name) <= order.index(node.group_name), key


def test_what_tables_hold_is_said_by_their_schema():
    metadata = defs.resolve_asset_graph().get(key_of("scene_metrics")).metadata
    columns = [column.name for column in metadata["dagster/column_schema"].columns]
    assert columns == list(COLUMNS)


def test_what_may_go_wrong_unnoticed_is_a_check_of_its_own():
    named_checks = {stage.name: stage.named_checks for stage in STAGES}
    assert [
        name for name in ("sweeps", "field", "novel_views", "scene_metrics") if not named_checks[name]
    ] == []


def test_workspace_file_and_project_load_the_same_location(run_process, tmp_path):
    command = ("dagster", "schedule", "list", "--name")
    by_file = run_process(*command, "-w", "workspace.yaml", DAGSTER_HOME=str(tmp_path))
    by_project = run_process(*command, DAGSTER_HOME=str(tmp_path))
    assert by_file.returncode == by_project.returncode == 0, by_file.stderr + by_project.stderr
    assert _without_log(by_file.stdout) == _without_log(by_project.stdout)
    assert "weekly_regeneration" in _without_log(by_file.stdout)


def test_nothing_in_the_checkout_makes_dagster_warn_at_its_start(run_process, repo, tmp_path):
    (tmp_path / "dagster.yaml").write_text((repo / "pipelines/dagster.yaml").read_text())
    done = run_process("dagster", "instance", "info", DAGSTER_HOME=str(tmp_path))
    assert done.returncode == 0 and "arning" not in done.stdout + done.stderr, done.stderr


def _without_log(text):
    return [line for line in text.splitlines() if "dagster.code_server" not in line]


def test_the_jobs_that_the_readme_names_exist():
    names = {job.name for job in defs.resolve_all_job_defs()}
    assert {"train_all_scenes", "train_scene", "regenerate_synthetic", "benchmark"} <= names


def test_the_schedule_skips_where_nothing_is_trained(tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path))
    context = dg.build_schedule_context(
        scheduled_execution_time=datetime.datetime(2026, 11, 22, 3, tzinfo=datetime.UTC)
    )
    tick = weekly_regeneration.evaluate_tick(context)
    assert tick.run_requests == [] and tick.skip_message == "no scene has a trained field"


@pytest.mark.parametrize("name", ["in_process", "multiprocess", ""])
def test_the_executor_is_chosen_by_the_environment(monkeypatch, name):
    monkeypatch.setenv("NVSF_EXECUTOR", name)
    assert executor_from_environment().name == (name or "multiprocess")


def test_an_unknown_executor_is_refused_by_name(monkeypatch):
    monkeypatch.setenv("NVSF_EXECUTOR", "dask")
    with pytest.raises(RecipeError, match="dask"):
        executor_from_environment()


def test_the_benchmark_is_the_same_flow_without_data_sets_one_step_at_a_time():
    training = defs.resolve_job_def("train_all_scenes")
    benchmark = defs.resolve_job_def("benchmark")
    names = {node.name for node in benchmark.nodes}
    assert {node.name for node in training.nodes} - names == {"dataset_of_scene"}
    evaluated = benchmark.executor_def.apply_config_mapping({})
    assert evaluated.value["config"]["max_concurrent"] == 1
