"""`nvsf verify` says of what it has verified nothing, and ends with 1 where that was asked for."""

import pytest
from click.testing import CliRunner

from nvsf_core.stages.runner.record import RECORD_NAME
from nvsf_core.stores.documents import write_document
from pipelines.cli import main
from tests.records import record_of_output


@pytest.fixture
def ask(tiny_catalogue, tmp_path, monkeypatch):
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    return lambda *words: CliRunner().invoke(main, words)


def test_a_named_scene_that_is_not_trained_is_not_verified(ask):
    said = ask("verify", "tiny")
    assert said.exit_code == 1 and said.output.startswith("tiny: NOT VERIFIED: no trained field"), said.output


def test_scenes_without_a_field_or_a_catalogue_are_named(ask, tmp_path):
    said = ask("verify")
    assert said.exit_code == 0 and said.output.startswith("nothing was verified: "), said.output
    (tmp_path / "home/tiny/frames").mkdir(parents=True)
    field = tmp_path / "home/elsewhere/field/lean/0"
    field.mkdir(parents=True)
    write_document(field / RECORD_NAME, record_of_output())
    said = ask("verify")
    assert said.exit_code == 1
    assert [line.partition(", and")[0].partition(" under")[0] for line in said.output.splitlines()] == [
        "tiny: NOT VERIFIED: no trained field of it that can be read lies",
        "elsewhere: NOT VERIFIED: trained",
        "nothing was verified: no scene of the catalogue is trained",
    ]
