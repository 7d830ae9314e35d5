"""From stage to asset: nothing is lost, nothing unsound is published."""

import dataclasses
import json

import dagster as dg
import pytest

from assets.factory import asset_of
from assets.metadata import picture, rounded, scalar_metadata
from assets.scenes import register
from assets.verdicts import CHECK_NAME
from assets.workspace import Workspace
from nvsf_core.stages.runner.failures import remembered_failures
from nvsf_core.stages.runner.record import content_of
from nvsf_core.stages.runner.stage import Check, NamedCheck, Stage, StageOutput
from pipelines.definitions import defs

PNG = b"\x89PNG\r\n\x1a\n"
"""How a picture's file begins."""


def _stage(run):
    return Stage(name="frames", group="ingest", inputs=(), description="rows", version="7", run=run)


@pytest.fixture
def materialize(tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path))

    def make(run):
        stage = _stage(run)
        instance = dg.DagsterInstance.ephemeral()
        register(instance, ["demo"])
        return dg.materialize(
            [asset_of(stage, [stage])], partition_key="demo", resources={"workspace": Workspace()},
            instance=instance, raise_on_error=False,
        )  # fmt: skip

    return make


def _output(*checks):
    def run(task):
        (task.folder / "top.png").write_bytes(PNG)
        return StageOutput(metadata={"rows": 3}, checks=list(checks), previews={"top": "top.png"})

    return run


def test_an_output_has_numbers_a_picture_and_a_check(materialize, tmp_path):
    result = materialize(_output(Check(name="law", passed=True, detail="3 of 3", blocking=True)))
    (event,) = result.get_asset_materialization_events()
    metadata = event.materialization.metadata
    assert event.partition == "demo"
    assert metadata["rows"].value == 3 and metadata["path"].value == str(tmp_path / "demo/frames")
    took = [metadata[name] for name in ("seconds", "peak_memory_mb", "read_mb", "written_mb")]
    assert all(isinstance(one, dg.FloatMetadataValue) and one.value == rounded(one.value) for one in took)
    assert metadata["preview_top"].value.startswith("![top](data:image/png;base64,")
    (check,) = result.get_asset_check_evaluations()
    assert check.check_name == CHECK_NAME and check.passed and check.metadata["law"].value == "holds: 3 of 3"
    assert check.partition == "demo"
    record = json.loads((tmp_path / "demo/frames/stage.json").read_text())
    assert event.materialization.tags["dagster/data_version"] == content_of(record)


def test_a_failed_blocking_law_publishes_nothing(materialize, tmp_path):
    result = materialize(_output(Check(name="law", passed=False, detail="2 of 3", blocking=True)))
    assert not result.success and not (tmp_path / "demo/frames").exists()
    (check,) = result.get_asset_check_evaluations()
    assert not check.passed and "law: 2 of 3" in check.description


def test_what_an_asset_failed_with_is_remembered_until_it_succeeds(materialize, tmp_path):
    def said():
        return remembered_failures(tmp_path, ["frames"])

    materialize(_output(Check(name="rows_are_whole", passed=False, detail="2 of 3", blocking=True)))
    assert said().keys() == {"demo"} and said()["demo"].startswith("frames: rows_are_whole: 2 of 3 (20")
    materialize(_output())
    assert said() == {}


def test_a_scene_that_cannot_be_planned_is_remembered_too(materialize, tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_KEEP_VERSIONS", "few")
    materialize(_output())
    assert "NVSF_KEEP_VERSIONS='few'" in remembered_failures(tmp_path, ["frames"])["demo"]


def test_a_failed_law_that_does_not_block_warns(materialize, tmp_path):
    result = materialize(_output(Check(name="law", passed=False, detail="2 of 3")))
    assert result.success and (tmp_path / "demo/frames").is_dir()
    (check,) = result.get_asset_check_evaluations()
    assert not check.passed and check.severity is dg.AssetCheckSeverity.WARN


def test_a_check_that_an_earlier_output_never_had_is_no_pass(materialize, tmp_path):
    later = NamedCheck(name="rows_are_whole", description="All rows are there.")
    assert materialize(_output()).success
    stage = dataclasses.replace(_stage(_output()), named_checks=(later,))
    with dg.DagsterInstance.ephemeral() as instance:
        register(instance, ["demo"])
        done = dg.materialize(
            [asset_of(stage, [stage])], partition_key="demo", instance=instance,
            resources={"workspace": Workspace()},
        )  # fmt: skip
    assert done.success
    (said,) = (one for one in done.get_asset_check_evaluations() if one.check_name == later.name)
    assert (said.passed, said.severity) == (False, dg.AssetCheckSeverity.WARN)
    assert "not run: this output was made before the check was" in said.description


def test_a_large_picture_is_named_instead_of_stored(tmp_path):
    path = tmp_path / "large.png"
    path.write_bytes(PNG + bytes(100_000))
    assert picture(path) == dg.MetadataValue.path(str(path))


@pytest.mark.parametrize(
    ("value", "shown"), [(0.123456789, 0.12346), (1234567.891, 1234568), (-2.0, -2.0), (1.23e-9, 1.23e-9)]
)
def test_numbers_are_rounded_for_reading(value, shown):
    assert rounded(value) == shown


def test_values_keep_their_type():
    typed = scalar_metadata({"a": True, "b": 2, "c": 0.5, "d": "word"})
    assert [value.value for value in typed.values()] == [True, 2, 0.5, "word"]
    assert isinstance(typed["a"], dg.BoolMetadataValue) and isinstance(typed["b"], dg.IntMetadataValue)


def test_a_run_that_samples_anew_has_a_seed_of_its_own_unless_it_names_one(tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path))
    tags = defs.resolve_job_def("regenerate_synthetic").tags
    seeds = []

    def note(task):
        seeds.append(task.config.draw_seed)
        return StageOutput()

    def made_by(tags, **config):
        stage = dataclasses.replace(_stage(note), version=str(len(seeds)))
        with dg.DagsterInstance.ephemeral() as instance:
            register(instance, ["demo"])
            done = dg.materialize(
                [asset_of(stage, [stage])], partition_key="demo", instance=instance, tags=tags,
                resources={"workspace": Workspace(**config)},
            )  # fmt: skip
        return done.run_id

    runs = [made_by(tags), made_by(tags), made_by(tags, draw_seed=5), made_by(tags, draw_seed=0), made_by({})]
    assert seeds == [int(runs[0][:7], 16), int(runs[1][:7], 16), 5, 0, 0]
