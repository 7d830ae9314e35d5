"""What the UI marks as out of date after `train_all_scenes`, by Dagster's own resolver."""

import dataclasses
import shutil

import dagster as dg
import pytest
from dagster._core.definitions.data_version import CachingStaleStatusResolver
from dagster._core.loader import LoadingContextForTest

from assets.drives import drive_assets, versions_of
from assets.factory import asset_of
from assets.scenes import DATA_VERSION, key_of
from assets.workspace import Workspace
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.stages import find_scene
from nvsf_core.stages.runner.stage import Stage, StageOutput
from nvsf_core.stores.tables import write_rows
from pipelines.resources import RESOURCES
from pipelines.train_all import make_train_all_scenes
from tests.conftest import TINY_CATALOGUE

POSES = "drive/data_poses/2013_05_28_drive_9900_sync/poses.txt"


def _measure(task):
    write_rows(task.folder / "metrics.parquet", [], COLUMNS)
    return StageOutput()


def _stage(name, **more):
    return Stage(name=name, description="nothing", version="1", **{"run": lambda _: StageOutput(), **more})


FLOW = (
    _stage("frames", group="ingest", inputs=(), reads_drive=True),
    _stage("sweeps", group="ingest", inputs=("frames",)),
    _stage(
        "scene_metrics", group="report", inputs=("sweeps",), reads_views=True, per_recipe=True, run=_measure
    ),
)
NAMES = [stage.name for stage in FLOW]


@pytest.fixture
def flow(tiny_catalogue, tmp_path, monkeypatch):
    """A home of a tiny flow: what trains it, and what the UI says of each stage."""
    (tmp_path / "scenes.toml").write_text(TINY_CATALOGUE)
    shutil.copytree(tiny_catalogue.parent / "drive", tmp_path / "drive")
    monkeypatch.setenv("NVSF_SCENES", str(tmp_path / "scenes.toml"))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    with dg.DagsterInstance.ephemeral() as instance:
        yield Watched(instance)


@dataclasses.dataclass
class Watched:
    instance: dg.DagsterInstance
    stages: tuple[Stage, ...] = FLOW

    def train(self):
        config = {"ops": {"choose_scenes": {"config": {"scenes": ["tiny"]}}}}
        made = make_train_all_scenes(self.stages).execute_in_process(
            run_config=config, instance=self.instance
        )
        assert made.success

    def observe(self):
        """Report the sources as `new_drives` does at its first tick."""
        for name, version in versions_of(find_scene("tiny"), Workspace()).items():
            seen = dg.AssetObservation(asset_key=key_of(name), partition="tiny", tags={DATA_VERSION: version})
            self.instance.report_runless_asset_event(seen)

    @property
    def definitions(self):
        assets = [*(asset_of(stage, self.stages) for stage in self.stages), *drive_assets]
        return dg.Definitions(assets=assets, resources=RESOURCES)

    def out_of_date(self):
        graph = self.definitions.get_repository_def().asset_graph
        found = CachingStaleStatusResolver(self.instance, graph, LoadingContextForTest(self.instance))
        return {
            name: [cause.reason for cause in found.get_stale_causes(key_of(name), "tiny")]
            for name in NAMES
            if found.get_status(key_of(name), "tiny").value != "FRESH"
        }


def test_what_was_trained_just_now_is_not_marked_nor_is_what_is_only_seen_or_reported_again(flow):
    flow.train()
    assert flow.out_of_date() == {}
    flow.observe()
    assert flow.out_of_date() == {}
    done = dg.materialize(
        [asset_of(FLOW[0], FLOW)], partition_key="tiny", instance=flow.instance,
        resources={"workspace": Workspace()},
    )  # fmt: skip
    assert done.success
    assert flow.out_of_date() == {}, "the same content was reported again"


def test_new_code_is_marked_where_it_is(flow):
    flow.train()
    flow.stages = (FLOW[0], dataclasses.replace(FLOW[1], version="2"), FLOW[2])
    assert flow.out_of_date() == {"sweeps": ["has a new code version"]}
    flow.train()
    assert flow.out_of_date() == {}


@pytest.mark.parametrize("is_seen_before", [True, False])
def test_a_changed_drive_is_marked_also_if_no_sensor_ran_before_the_training(flow, tmp_path, is_seen_before):
    if is_seen_before:
        flow.observe()
    flow.train()
    with (tmp_path / POSES).open("a") as poses:
        poses.write("\n")
    flow.observe()
    assert flow.out_of_date() == {"frames": ["has a new dependency data version"]}
    flow.train()
    assert flow.out_of_date() == {}


def test_a_drive_that_changed_unseen_and_was_trained_is_not_marked_once_it_is_seen(flow, tmp_path):
    flow.observe()
    with (tmp_path / POSES).open("a") as poses:
        poses.write("\n")
    flow.train()
    flow.observe()
    assert flow.out_of_date() == {}


def test_a_view_that_is_asked_for_anew_is_marked(flow, tmp_path):
    flow.train()
    catalogue = tmp_path / "scenes.toml"
    catalogue.write_text(catalogue.read_text() + '\n[[view]]\nname = "up"\nshift_m = [0.0, 0.0, 1.0]\n')
    flow.observe()
    assert flow.out_of_date() == {"scene_metrics": ["has a new dependency data version"]}
