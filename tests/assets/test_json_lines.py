"""Logs as JSON lines: what they say, and that a disk that refuses stops nothing."""

import json
import logging

from assets.json_lines import JsonLines


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
