"""What a run is asked for in the UI's launchpad is described there, and what it lets through is taken."""

import dagster as dg
import pytest

from assets.factory import asset_of
from assets.scenes import register
from nvsf_core.stages.runner.stage import Stage, StageOutput
from pipelines.definitions import defs
from pipelines.resources import RESOURCES
from pipelines.train_all import SceneChoice

OURS = {
    "train_scene": {"recipe", "seed", "draw_seed", "dataset_label", "log_level"},
    "train_all_scenes": {"recipe", "seed", "draw_seed", "dataset_label", "log_level", "scenes"},
}


def _descriptions(shape):
    for name, field in getattr(shape, "fields", {}).items():
        yield name, field.description
        yield from _descriptions(field.config_type)


@pytest.mark.parametrize("job", OURS)
def test_the_launchpad_describes_each_setting(job):
    found = dict(_descriptions(defs.resolve_job_def(job).run_config_schema.config_type))
    assert [name for name in sorted(OURS[job]) if not found[name]] == []


def test_a_setting_that_is_null_is_as_one_that_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path))
    monkeypatch.setenv("RECIPE", "smoke")
    asked = []

    def note(task):
        asked.append((task.config.recipe.name, task.config.seed, task.config.dataset_label))
        return StageOutput()

    stage = Stage(name="frames", group="ingest", inputs=(), description="rows", version="1", run=note)
    nulls = dict.fromkeys(("recipe", "seed", "draw_seed", "dataset_label"))
    with dg.DagsterInstance.ephemeral() as instance:
        register(instance, ["demo"])
        done = dg.materialize(
            [asset_of(stage, [stage])], partition_key="demo", instance=instance, resources=RESOURCES,
            run_config={"resources": {"workspace": {"config": nulls}}}, raise_on_error=False,
        )  # fmt: skip
    assert done.success and asked == [("smoke", 0, "manual")]
    assert not SceneChoice(scenes=None).scenes
