"""The report is made once after a regeneration of many scenes, and not while one of its runs goes on."""

import datetime
from collections.abc import Iterator
from pathlib import Path

import dagster as dg
import pytest

from assets.scenes import key_of, register
from nvsf_core.stores.documents import write_document
from pipelines.definitions import defs
from pipelines.schedules import weekly_regeneration
from pipelines.weekly_report import report_follows
from tests.records import record_of_output


@pytest.fixture
def instance(
    tiny_catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[dg.DagsterInstance]:
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    with dg.DagsterInstance.ephemeral() as made:
        register(made, ["tiny"])
        yield made


def _tick(instance: dg.DagsterInstance) -> dg.RunRequest | str:
    """What the sensor asks for; else why it asks for nothing."""
    data = report_follows.evaluate_tick(
        dg.build_sensor_context(instance=instance, repository_def=defs.get_repository_def())
    )
    return data.run_requests[0] if data.run_requests else data.skip_message


def test_the_report_is_made_once_after_all_runs_of_a_regeneration(instance: dg.DagsterInstance) -> None:
    job = defs.resolve_job_def("regenerate_synthetic")
    assert "no run of regenerate_synthetic has ended" in _tick(instance)
    waiting = instance.create_run_for_job(job)
    done = job.execute_in_process(instance=instance, partition_key="tiny", asset_selection=[key_of("frames")])
    assert done.success
    assert _tick(instance) == "runs of regenerate_synthetic have not ended yet"
    instance.report_run_failed(waiting, "a scene's run fails alone")
    request = _tick(instance)
    assert request.run_key == waiting.run_id and request.partition_key is None
    assert request.tags["dagster/max_retries"] == "2"
    assert _tick(instance).run_key == request.run_key, "the daemon launches one run a key"
    report = defs.resolve_job_def("make_report").execute_in_process(instance=instance)
    assert {event.asset_key.path[-1] for event in report.get_asset_materialization_events()} == {
        "benchmark_report"
    }
    assert "no run of regenerate_synthetic has ended" in _tick(instance)


def test_a_regeneration_whose_process_dies_is_launched_again(
    tiny_catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path))
    field = tmp_path / "tiny/field/smoke/0"
    field.mkdir(parents=True)
    write_document(field / "stage.json", record_of_output())
    sunday = datetime.datetime(2026, 11, 22, 3, tzinfo=datetime.UTC)
    with dg.instance_for_test() as made:
        context = dg.build_schedule_context(
            instance=made, scheduled_execution_time=sunday, repository_def=defs.get_repository_def()
        )
        (request,) = weekly_regeneration.evaluate_tick(context).run_requests
    assert request.tags["dagster/max_retries"] == "2" and request.tags["nvsf/label"] == "2026-W47"
