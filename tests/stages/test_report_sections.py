"""Sections of the report are taken over from the one before, where nothing of their scenes has changed."""

import re
import shutil
from pathlib import Path

from nvsf_core.stages.benchmark_report import make_benchmark_report
from tests.reporting.street_store import write_street


def test_a_page_with_sections_taken_over_is_as_one_made_anew(tmp_path: Path) -> None:
    write_street(tmp_path, "street")
    changed = write_street(tmp_path, "avenue")
    report = tmp_path / "benchmark_report"
    make_benchmark_report(tmp_path, [], {}, [])
    first = (report / "views/street/test.html").stat().st_ino
    record = changed.path("scene_metrics/quick/0") / "stage.json"
    record.write_text(record.read_text().replace('"seconds"', ' "seconds"', 1))
    taken_over = make_benchmark_report(tmp_path, [], {}, []).read_text(encoding="utf-8")
    assert (report / "views/street/test.html").stat().st_ino == first
    shutil.rmtree(report)
    anew = make_benchmark_report(tmp_path, [], {}, []).read_text(encoding="utf-8")
    made = re.compile(r"Made [-0-9: ]+ UTC")
    assert made.sub("", taken_over) == made.sub("", anew)


def test_a_section_whose_pages_are_gone_is_made_again(tmp_path: Path) -> None:
    write_street(tmp_path, "street")
    report = tmp_path / "benchmark_report"
    make_benchmark_report(tmp_path, [], {}, [])
    (report / "views/street/test.html").unlink()
    (report / "made_from.sha256").unlink()
    make_benchmark_report(tmp_path, [], {}, [])
    assert (report / "views/street/test.html").is_file()


def test_a_scene_that_could_not_be_read_is_read_again_once_it_is_mended(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street")
    array = store.path("novel_views/quick/0") / "test" / "model.zarr" / "points_m"
    array.rename(array.with_name("lost"))
    words = "what was published cannot be read"
    assert words in make_benchmark_report(tmp_path, [], {}, []).read_text(encoding="utf-8")
    array.with_name("lost").rename(array)
    (tmp_path / "benchmark_report" / "made_from.sha256").unlink()
    assert words not in make_benchmark_report(tmp_path, [], {}, []).read_text(encoding="utf-8")
