"""Logs as JSON lines: what they say, and that a disk that refuses stops nothing."""

import json
import logging

import pytest

from assets.json_lines import JsonLines, facts_of


def test_a_json_line_says_what_a_stage_took_and_a_full_disk_stops_nothing(tmp_path, monkeypatch):
    logger = logging.Logger("test")
    logger.addHandler(JsonLines(str(tmp_path / "log.jsonl")))
    logger.info("[a] mesh: done in 3.5 s, 812 MB of memory, read 12 MB, wrote 4 MB")
    logger.warning("torn\nin two")
    first, second = (json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines())
    taken = {"seconds": 3.5, "peak_memory_mb": 812.0, "read_mb": 12.0, "written_mb": 4.0}
    assert first.items() >= {"scene": "a", "stage": "mesh", "level": "info", **taken}.items()
    assert second["message"] == "torn\nin two" and "scene" not in second
    monkeypatch.setattr(logging, "raiseExceptions", False)
    logger.handlers = [JsonLines("/dev/full")]
    logger.info("[a] mesh: started")


@pytest.mark.parametrize(
    ("message", "stage"),
    [
        ("[a] field: done in 3.2 s", "field"),
        ("[a] FAILED in field: non-finite loss", "field"),
        ("[a] field, lidar: step 100/900", "field"),
        ("[a] dataset/left/W1-0123abcd: removed by NVSF_KEEP_VERSIONS=2", "dataset"),
        ("[a] no data, left out: drive: no data at /x", None),
        ("[a] drive: written in 3.0 s", None),
    ],
)
def test_the_stage_of_a_line_is_a_stage_or_none(message, stage):
    facts = facts_of(logging.LogRecord("x", logging.INFO, "", 0, message, (), None))
    expected = None if stage is None else "a"
    assert (facts["scene"], facts.get("stage"), facts.get("partition")) == ("a", stage, expected)


def test_the_file_s_folder_is_made_and_a_place_that_refuses_is_told_once(tmp_path, capsys):
    logger = logging.Logger("test")
    logger.addHandler(JsonLines(str(tmp_path / "logs/of/runs.jsonl")))
    logger.info("[a] mesh: started")
    assert json.loads((tmp_path / "logs/of/runs.jsonl").read_text())["stage"] == "mesh"
    logger.handlers = [JsonLines(str(tmp_path / "logs/of/runs.jsonl/below"))]
    logger.info("one")
    logger.info("two")
    assert capsys.readouterr().err.count("--- Logging error ---") == 1
