"""A catalogue that cannot be read for a while costs no scene its run: it waits, or is launched again."""

import threading
from collections.abc import Iterator
from pathlib import Path

import dagster as dg
import pytest

from assets.automation import CATALOGUE_TAGS, KEPT_TAGS
from assets.scenes import key_of, register
from nvsf_core.stages.runner import patience
from pipelines.catalogue_runs import LAUNCHED_TAG, catalogue_again
from pipelines.definitions import defs
from pipelines.jobs import RETRY_TAGS
from tests.conftest import TINY_CATALOGUE

BROKEN = TINY_CATALOGUE + "[[scene"
DAEMONS_TAGS = {**KEPT_TAGS, **RETRY_TAGS}
"""Of a run that `scenes_follow` launches."""


@pytest.fixture
def catalogue(tiny_catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One that is half typed, of a drive that is there."""
    path = tmp_path / "scenes.toml"
    path.write_text(BROKEN)
    (tmp_path / "drive").symlink_to(tiny_catalogue.parent / "drive")
    monkeypatch.setenv("NVSF_SCENES", str(path))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    return path


@pytest.fixture
def instance() -> Iterator[dg.DagsterInstance]:
    with dg.instance_for_test() as made:
        register(made, ["tiny"])
        yield made


def _run(instance: dg.DagsterInstance, tags: dict[str, str]) -> dg.ExecuteInProcessResult:
    return defs.resolve_implicit_global_asset_job_def().execute_in_process(
        partition_key="tiny", instance=instance, tags=tags, raise_on_error=False,
        asset_selection=[key_of("frames")],
    )  # fmt: skip


def _tick(instance: dg.DagsterInstance) -> dg.RunRequest | str:
    """What the sensor asks for; else why it asks for nothing."""
    # As the daemon makes it: that of `build_sensor_context` knows no partition.
    with dg.SensorEvaluationContext(instance.get_ref(), repository_def=defs.get_repository_def()) as context:
        data = catalogue_again.evaluate_tick(context)
    return data.run_requests[0] if data.run_requests else data.skip_message


def test_a_step_waits_for_a_catalogue_that_is_being_edited(
    instance: dg.DagsterInstance, catalogue: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    mended = threading.Timer(2.5, catalogue.write_text, [TINY_CATALOGUE])
    mended.start()
    done = _run(instance, {})
    mended.join()
    assert done.success
    said = [line for line in capfd.readouterr().err.splitlines() if "waits up to 60 s" in line]
    assert len(said) == 1 and "scenes.toml is no TOML" in said[0]


def test_what_failed_for_the_catalogue_is_launched_again_once_it_can_be_read(
    instance: dg.DagsterInstance, catalogue: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patience, "PATIENCE_S", 0.5)
    failed = _run(instance, DAEMONS_TAGS)
    assert not failed.success and instance.get_run_by_id(failed.run_id).tags.items() >= CATALOGUE_TAGS.items()
    assert "scenes.toml is no TOML" in _tick(instance), "not before"
    catalogue.write_text(TINY_CATALOGUE)
    request = _tick(instance)
    assert (request.run_key, request.job_name) == (failed.run_id, "train_scene")
    assert request.asset_selection == [key_of("frames")] and request.tags.items() >= DAEMONS_TAGS.items()
    again = defs.resolve_job_def("train_scene").execute_in_process(
        partition_key=request.partition_key, instance=instance, tags=request.tags,
        asset_selection=request.asset_selection,
    )  # fmt: skip
    assert again.success
    assert "no run" in _tick(instance), "not twice"


@pytest.mark.parametrize("tags", [{}, DAEMONS_TAGS | {LAUNCHED_TAG: "5"}])
def test_what_a_person_launched_or_failed_often_is_not_launched_again(
    instance: dg.DagsterInstance, catalogue: Path, monkeypatch: pytest.MonkeyPatch, tags: dict[str, str]
) -> None:
    monkeypatch.setattr(patience, "PATIENCE_S", 0.0)
    assert not _run(instance, tags).success
    catalogue.write_text(TINY_CATALOGUE)
    assert "no run" in _tick(instance)


def test_a_run_that_fails_for_the_drive_is_not_launched_again(
    instance: dg.DagsterInstance, catalogue: Path
) -> None:
    catalogue.write_text(TINY_CATALOGUE)
    (catalogue.parent / "drive").unlink()
    assert not _run(instance, DAEMONS_TAGS).success
    assert "no run" in _tick(instance)
