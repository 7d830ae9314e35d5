"""A drive that comes in is made into a data set, by Dagster's own evaluation; what may not start does not."""

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import dagster as dg
import pytest
from dagster._core.remote_origin import (
    ManagedGrpcPythonEnvCodeLocationOrigin,
    RemoteJobOrigin,
    RemoteRepositoryOrigin,
)
from dagster._core.types.loadable_target_origin import LoadableTargetOrigin

from assets.automation import KEPT_TAGS
from assets.drives import VERSIONS, versions_of
from assets.offers import AGE_CHECK, RECIPE_CHECK
from assets.scenes import DATA_VERSION, PARTITION_TAG, SCENES, key_of
from assets.workspace import Workspace, catalogue
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import DataError
from nvsf_core.stages import STAGE_NAMES
from pipelines.definitions import defs
from pipelines.sensors import new_drives, scenes_follow
from tests.conftest import TINY_CATALOGUE

pytestmark = pytest.mark.usefixtures("without_lpips_and_mesh")
SEQUENCE = "2013_05_28_drive_9900_sync"
LANE = f"""
[[scene]]
name = "lane"
root = "drive"
sequence = "{SEQUENCE}"
first_frame = 0
last_frame = 2
test_frames = [1]

[[view]]
name = "left"
scenes = ["lane"]
frames = [1]
truth = {{ image_00 = "nowhere" }}
"""
"""A scene of the same drive, with a view whose true images are absent."""


@dataclass
class Watched:
    """An instance, a catalogue whose scene `tiny` has no drive yet, and what the daemon would do."""

    instance: dg.DagsterInstance
    folder: Path
    recorded: Path
    cursor: str | None = None
    evaluated: object = None
    said: list[str] = field(default_factory=list)

    @property
    def layout(self) -> DriveLayout:
        return DriveLayout(self.folder / "drive", SEQUENCE)

    def tick(self) -> dg.SensorResult:
        """What the daemon does at a tick of `new_drives`: add the partitions, report the events."""
        context = dg.build_sensor_context(instance=self.instance, cursor=self.cursor)
        result = new_drives(context)
        assert isinstance(result, dg.SensorResult)
        self.cursor = result.cursor
        self.said.append(result.skip_reason.skip_message if result.skip_reason else "")
        for request in result.dynamic_partitions_requests or []:
            if isinstance(request, dg.AddDynamicPartitionsRequest):
                self.instance.add_dynamic_partitions(request.partitions_def_name, request.partition_keys)
            else:
                for name in request.partition_keys:
                    self.instance.delete_dynamic_partition(request.partitions_def_name, name)
        for event in result.asset_events:
            self.instance.report_runless_asset_event(event)
        return result

    def requested(self) -> dict[str, set[str]]:
        """Asset to the partitions that `scenes_follow` would request now; the report is `nvsf/all`."""
        asked = self.instance.get_dynamic_partitions
        with pytest.MonkeyPatch.context() as patch:
            # Asked a thousand times in an evaluation, half of its time; nothing adds one meanwhile.
            patch.setattr(self.instance, "get_dynamic_partitions", cache(asked))
            result = dg.evaluate_automation_conditions(
                defs=defs, instance=self.instance, cursor=self.evaluated,
                asset_selection=dg.AssetSelection.all(),
            )  # fmt: skip
        self.evaluated = result.cursor
        found = {
            name: set(result.get_requested_partitions(key_of(name)) or ()) - {None} for name in STAGE_NAMES
        }
        if result.get_num_requested(key_of("benchmark_report")):
            found["benchmark_report"] = {"all"}
        return {name: scenes for name, scenes in found.items() if scenes}

    def run(self, last: str = STAGE_NAMES[-1], **choices: str) -> dg.ExecuteInProcessResult:
        """Run what was requested for `tiny`, up to a stage, as the daemon launches it."""
        stages = STAGE_NAMES[: STAGE_NAMES.index(last) + 1]
        return defs.resolve_implicit_global_asset_job_def().execute_in_process(
            partition_key="tiny", instance=self.instance, tags=KEPT_TAGS, raise_on_error=False,
            asset_selection=[key_of(name) for name in stages],
            run_config={"resources": {"workspace": {"config": choices}}},
        )  # fmt: skip

    def check(self, asset: str, name: str) -> bool:
        """The newest verdict of a check over all scenes."""
        found = self.instance.event_log_storage.get_asset_check_execution_history(
            dg.AssetCheckKey(key_of(asset), name), limit=1
        )
        data = found[0].event.dagster_event.event_specific_data
        return bool(data.passed)


@pytest.fixture
def watched(tiny_catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    (tmp_path / "scenes.toml").write_text(TINY_CATALOGUE)
    monkeypatch.setenv("NVSF_SCENES", str(tmp_path / "scenes.toml"))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NVSF_QUIET_S", "0")
    monkeypatch.setenv("NVSF_LOG_FILE", str(tmp_path / "log.jsonl"))
    with dg.DagsterInstance.ephemeral() as instance:
        yield Watched(instance, tmp_path, tiny_catalogue.parent / "drive")


@pytest.fixture
def arrived(watched: Watched) -> Watched:
    shutil.copytree(watched.recorded, watched.folder / "drive")
    watched.requested()
    watched.tick()
    return watched


def test_a_drive_that_is_still_copied_waits(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(watched.recorded, watched.folder / "drive")
    monkeypatch.setenv("NVSF_QUIET_S", "3600")
    result = watched.tick()
    assert "tiny waits: something changed" in watched.said[-1]
    assert not result.asset_events and not watched.instance.get_dynamic_partitions(SCENES.name)
    assert watched.requested() == {}


@pytest.mark.parametrize(
    ("lacks", "words"),
    [
        (lambda layout: layout.poses_path, "poses.txt not there yet"),
        (lambda layout: layout.scan_path(3), "1 scans or images lack"),
    ],
)
def test_a_drive_that_lacks_something_waits(
    watched: Watched, monkeypatch: pytest.MonkeyPatch, lacks: Callable[[DriveLayout], Path], words: str
) -> None:
    shutil.copytree(watched.recorded, watched.folder / "drive")
    lacks(watched.layout).unlink()
    # Unchanged for long enough to be whole, were nothing missing.
    monkeypatch.setattr("nvsf_core.drives.section._newest_s", lambda section: time.time() - 60.0)
    monkeypatch.setenv("NVSF_QUIET_S", "30")
    watched.tick()
    assert words in watched.said[-1] and not watched.instance.get_dynamic_partitions(SCENES.name)


def test_a_new_drive_is_made_into_a_data_set_once(arrived: Watched) -> None:
    assert arrived.instance.get_dynamic_partitions(SCENES.name) == ["tiny"]
    assert arrived.requested() == {name: {"tiny"} for name in STAGE_NAMES}, "in one run"
    assert arrived.requested() == {}, "not twice"
    assert arrived.run().success
    assert list((arrived.folder / "home/tiny/dataset/shift_1m").glob("*/manifest.json"))
    lines = [json.loads(line) for line in (arrived.folder / "log.jsonl").read_text().splitlines()]
    done = sorted((line["partition"], line["stage"]) for line in lines if "written_mb" in line)
    assert done == sorted(("tiny", name) for name in STAGE_NAMES), "each once; no job names our logger"
    arrived.tick()
    assert arrived.requested() == {"benchmark_report": {"all"}}
    assert arrived.tick().asset_events == [] and arrived.requested() == {}

    _an_old_data_set_is_told_of_and_a_copied_one_is_no_newer(arrived)
    _a_changed_view_starts_what_reads_it(arrived)
    _a_changed_recipe_is_offered_and_changes_nothing(arrived)
    _a_changed_drive_is_followed_with_the_recipe_that_the_scene_has(arrived)


def _an_old_data_set_is_told_of_and_a_copied_one_is_no_newer(arrived: Watched) -> None:
    assert arrived.check("dataset", AGE_CHECK)
    (record,) = (arrived.folder / "home/tiny/dataset/.index").rglob("stage.json")
    said = record.read_text()
    record.write_text(json.dumps(json.loads(said) | {"made_s": time.time() - 9 * 86_400}))
    arrived.tick()
    assert not arrived.check("dataset", AGE_CHECK), "although its file is new"
    record.write_text(said)
    arrived.tick()
    assert arrived.check("dataset", AGE_CHECK)


def _a_changed_view_starts_what_reads_it(arrived: Watched) -> None:
    catalogue = arrived.folder / "scenes.toml"
    catalogue.write_text(TINY_CATALOGUE.replace("frames = [1]", "frames = [1]\nyaw_deg = 5.0"))
    arrived.tick()
    assert set(arrived.requested()) == {"novel_views", "scene_metrics", "dataset"}


def _a_changed_recipe_is_offered_and_changes_nothing(arrived: Watched) -> None:
    catalogue = arrived.folder / "scenes.toml"
    catalogue.write_text(catalogue.read_text().replace('recipe = "smoke"', 'recipe = "quick"'))
    arrived.tick()
    assert not arrived.check("field", RECIPE_CHECK)
    assert arrived.requested() == {}
    catalogue.write_text(catalogue.read_text().replace('recipe = "quick"', 'recipe = "smoke"'))
    arrived.tick()
    assert arrived.check("field", RECIPE_CHECK)
    catalogue.write_text(catalogue.read_text().replace('recipe = "smoke"', 'recipe = "quick"'))
    arrived.tick()


def _a_changed_drive_is_followed_with_the_recipe_that_the_scene_has(arrived: Watched) -> None:
    poses = arrived.layout.poses_path
    os.utime(poses)
    assert arrived.tick().asset_events == [] and arrived.requested() == {}, "the same bytes"
    poses.write_text(poses.read_text() + "\n")
    arrived.tick()
    assert arrived.requested() == {name: {"tiny"} for name in STAGE_NAMES}
    assert arrived.run("field").success
    assert os.listdir(arrived.folder / "home/tiny/field") == ["smoke"]


def test_what_the_ui_s_button_observes_is_what_the_sensor_reports(arrived: Watched) -> None:
    assert arrived.requested()
    observed = defs.resolve_implicit_global_asset_job_def().execute_in_process(
        instance=arrived.instance, asset_selection=[key_of(name) for name in VERSIONS]
    )
    events = [one.asset_observation_data.asset_observation for one in observed.get_asset_observation_events()]
    (entry,) = (one for one in catalogue() if one.name == "tiny")
    digests = versions_of(entry, Workspace())
    assert {(one.asset_key, one.partition, one.tags[DATA_VERSION]) for one in events} == {
        (key_of(name), "tiny", digest) for name, digest in digests.items()
    }
    assert arrived.requested() == {}, "nothing changed"


def test_a_scene_that_cannot_be_read_hides_no_other_one_s_observation(arrived: Watched) -> None:
    (arrived.folder / "scenes.toml").write_text(TINY_CATALOGUE + LANE)
    arrived.instance.add_dynamic_partitions(SCENES.name, ["lane"])
    observed = defs.resolve_implicit_global_asset_job_def().execute_in_process(
        instance=arrived.instance, asset_selection=[key_of(name) for name in VERSIONS]
    )
    events = [one.asset_observation_data.asset_observation for one in observed.get_asset_observation_events()]
    found = {(one.asset_key.path[-1], one.partition) for one in events}
    assert found == {("drive", "tiny"), ("drive", "lane"), ("asked_views", "tiny")}, "truth is no drive's"


def test_a_drive_that_fails_is_not_tried_again_until_it_changes(arrived: Watched) -> None:
    assert arrived.requested()
    assert not arrived.run("frames", recipe="splendid").success
    for _ in range(2):
        arrived.tick()
        assert arrived.requested() == {}
    poses = arrived.layout.poses_path
    poses.write_text(poses.read_text() + "\n")
    arrived.tick()
    assert "frames" in arrived.requested()


def test_a_catalogue_that_cannot_be_read_fails_the_tick_and_removes_no_partition(arrived: Watched) -> None:
    (arrived.folder / "scenes.toml").write_text("[[scene]\n")
    with pytest.raises(DataError, match=r"scenes\.toml is no TOML"):
        arrived.tick()
    assert arrived.instance.get_dynamic_partitions(SCENES.name) == ["tiny"]


def test_a_scene_that_leaves_the_catalogue_is_no_partition_until_it_is_back(arrived: Watched) -> None:
    both = TINY_CATALOGUE + LANE.replace('truth = { image_00 = "nowhere" }\n', "")
    (arrived.folder / "scenes.toml").write_text(both)
    arrived.tick()
    assert set(arrived.instance.get_dynamic_partitions(SCENES.name)) == {"tiny", "lane"}
    (arrived.folder / "scenes.toml").write_text(TINY_CATALOGUE)
    arrived.tick()
    assert arrived.instance.get_dynamic_partitions(SCENES.name) == ["tiny"]
    result = arrived.tick()
    assert result.skip_reason and not result.dynamic_partitions_requests
    (arrived.folder / "scenes.toml").write_text(both)
    events = arrived.tick().asset_events
    assert {one.partition for one in events if isinstance(one, dg.AssetObservation)} == {"lane"}
    assert set(arrived.instance.get_dynamic_partitions(SCENES.name)) == {"tiny", "lane"}


def test_a_scene_that_leaves_the_catalogue_takes_its_queued_run_along_and_waits_for_one_at_work(
    arrived: Watched,
) -> None:
    (arrived.folder / "scenes.toml").write_text(TINY_CATALOGUE.replace('"tiny"', '"other"'))
    job, tags = defs.resolve_job_def("train_scene"), {PARTITION_TAG: "tiny"}
    target = LoadableTargetOrigin(module_name="pipelines.definitions")
    location = ManagedGrpcPythonEnvCodeLocationOrigin(target, location_name="nvsf")
    origin = RemoteJobOrigin(RemoteRepositoryOrigin(location, "__repository__"), "train_scene")
    queued, at_work = (
        arrived.instance.create_run_for_job(job, tags=tags, status=status, remote_job_origin=origin)
        for status in (dg.DagsterRunStatus.QUEUED, dg.DagsterRunStatus.STARTED)
    )
    arrived.tick()
    status = arrived.instance.get_run_by_id(queued.run_id).status
    assert status is dg.DagsterRunStatus.CANCELED, "else it fails for its partition, and the alarm is raised"
    assert "tiny" in arrived.instance.get_dynamic_partitions(SCENES.name), "its steps would fail in Dagster"
    arrived.instance.report_run_failed(at_work)
    arrived.tick()
    assert "tiny" not in arrived.instance.get_dynamic_partitions(SCENES.name)


def test_automation_is_off_unless_it_is_asked_for_and_its_runs_keep_their_recipe() -> None:
    assert scenes_follow.default_status is dg.DefaultSensorStatus.STOPPED
    assert KEPT_TAGS.items() <= scenes_follow.run_tags.items()
    assert new_drives.default_status is dg.DefaultSensorStatus.RUNNING
