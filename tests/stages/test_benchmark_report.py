"""The report shows what was measured, says what was not, and needs nothing but itself."""

import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.errors import StoreError
from nvsf_core.metrics.table import COLUMNS, UNITS
from nvsf_core.reporting import plots
from nvsf_core.reporting.html import higher_is_better as is_likeness
from nvsf_core.reporting.scan_page.page import MOST_BYTES
from nvsf_core.reporting.scene_notes import holds_paper_scene
from nvsf_core.stages import benchmark_report
from nvsf_core.stages.benchmark_report import make_benchmark_report
from nvsf_core.stages.runner.failures import forget_failure, remember_failure
from nvsf_core.stores.arrays import read_arrays, read_attrs, write_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import read_rows, write_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "reporting"))
from street_store import add_view, write_street  # tests are no package

from tests.records import record_of_output


class _Outline(HTMLParser):
    """Text, and tags that are open without end."""

    def __init__(self) -> None:
        super().__init__()
        self.text: list[str] = []
        self.open: list[str] = []
        self.wrong: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def _read(path: Path) -> tuple[str, str]:
    page = path.read_text(encoding="utf-8")
    outline = _Outline()
    outline.feed(page)
    assert not outline.wrong
    assert not outline.open
    return page, " ".join(" ".join(outline.text).split())


@pytest.fixture(scope="module", autouse=True)
def _equal_plots_are_drawn_once() -> Iterator[None]:
    """Most pages show the same two, which take more than half of a page's time."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("cost_error_png", "curve_png"):
            patch.setattr(plots, name, _drawn_once(getattr(plots, name)))
        yield


def _drawn_once(draw: Callable[[object], bytes]) -> Callable[[object], bytes]:
    drawn: dict[str, bytes] = {}

    def png(asked: object) -> bytes:
        if repr(asked) not in drawn:
            drawn[repr(asked)] = draw(asked)
        return drawn[repr(asked)]

    return png


def test_the_page_stands_alone_and_shows_model_and_baselines(tmp_path: Path) -> None:
    write_street(tmp_path, "street", points_every=1)
    path = make_benchmark_report(tmp_path, ["street"], {}, [])
    assert path == tmp_path / "benchmark_report" / "index.html"
    page, text = _read(path)
    links = re.findall(r'(?:src|href)="(?!data:|#)([^"]*)', page)
    assert links.pop(0) == "versions.html"
    assert links == ["views/street/test.html", "views/street/shift_1m.html"]
    for link in links:
        scans = (path.parent / link).read_text(encoding="utf-8")
        assert "://" not in scans and not re.findall(r"(?:src|href)=", scans), "it needs no network either"
        assert scans.count('"frame":7') == 1 and len(scans) < MOST_BYTES
    assert "<script" not in page
    assert "://" not in page
    for words in ("quick is best in 9 of 9", "reproject", "copy_nearest", "mesh", "lidar4d_scan", "118.0",
                  "1 234 567", "Held-out frame 7", "View shift_1m", "Not measured on KITTI-360’s ten scenes",
                  "defined on", "What the training scans prove", "moving objects", "184 223",
                  "scans_look_recorded"):  # fmt: skip
        assert words in text or words in page, words
    assert page.count("data:image/png") >= 14


def test_a_view_that_images_answered_in_part_says_so(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street")
    view = store.path("novel_views/quick/0") / "shift_1m" / "model.zarr"
    shown = "images show the surface"
    assert shown not in _read(make_benchmark_report(tmp_path, ["street"], {}, []))[1]
    arrays, attrs = read_arrays(view), read_attrs(view)
    shutil.rmtree(view)
    write_arrays(view, arrays, attrs | {"above_lasers_by_images": True})
    shutil.rmtree(tmp_path / "benchmark_report")  # nothing was published, so it would be kept
    assert _read(make_benchmark_report(tmp_path, ["street"], {}, []))[1].count(shown) == 1


def test_a_view_with_known_truth_is_shown_beside_it_with_the_best_baseline_and_the_error(
    tmp_path: Path,
) -> None:
    store = write_street(tmp_path, "street")
    views, metrics = store.path("novel_views/quick/0"), store.path("scene_metrics/quick/0")
    true = read_arrays(views / "test/reproject.zarr", "image_00_rgb", "image_00_frame")
    for method in ("reproject", "mesh"):
        attrs = {"sensor": "", "cameras": ["image_00"]}  # as of a real drive, where only images are measured
        write_arrays(views / "shift_1m" / f"{method}.zarr", true, attrs)
    valid = {"image_00_valid": np.ones(true["image_00_rgb"].shape[1:3], bool), "image_00_row": np.array([0])}
    write_arrays(metrics / "shift_1m" / "truth.zarr", true | valid, {"cameras": ["image_00"]})
    rows = read_rows(metrics / "metrics.parquet")
    own = {"split": "shift_1m", "protocol": "image", "sensor": "image_00", "frame": 7}
    psnr_db = {"quick": 24.5, "reproject": 33.25, "mesh": 21.0}
    named = {row["recipe"]: row for row in rows if row["recipe"] in psnr_db}
    for recipe, value in psnr_db.items():
        for metric, number in (("image_psnr_db", value), ("image_missing", 0.125)):
            rows.append(named[recipe] | own | {"metric": metric, "value": number, "unit": UNITS[metric]})
    write_rows(metrics / "metrics.parquet", rows, COLUMNS)
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    view = text.split("View shift_1m")[1].split("Training")[0]
    for words in ("what its images should show is known", "no answer", "0.125", "64 of 255 or more"):
        assert words in view, words
    assert "truth quick: 24.5 dB reproject: 33.2 dB quick: error" in view
    assert "mesh:" not in view, "only the best baseline is shown, and it has no scan"


def test_a_page_with_one_of_the_papers_scenes_does_not_say_that_none_was_measured(
    tmp_path: Path,
) -> None:
    write_street(tmp_path, "kitti360_1908")
    assert "Not measured on KITTI-360" not in _read(make_benchmark_report(tmp_path, [], {}, []))[1]


def test_the_ten_scenes_are_the_catalogue_s(repo: Path) -> None:
    named = {entry.name for entry in load_catalogue([repo / "scenes.toml"], None)} - {"demo"}
    assert len(named) == 10 and all(holds_paper_scene([name]) for name in named)


def test_failures_and_absent_scenes_are_named_with_the_reason(tmp_path: Path) -> None:
    write_street(tmp_path, "street")
    path = make_benchmark_report(
        tmp_path, ["street"], {"other": "poses.txt line 3: <nan>"}, ["kitti360_1908"]
    )
    page, text = _read(path)
    assert "poses.txt line 3: &lt;nan&gt;" in page
    assert "other failed:" in text
    assert "No data on this machine for these scenes of the catalogue: kitti360_1908" in text


def test_a_failed_scene_keeps_what_it_published_before(tmp_path: Path) -> None:
    write_street(tmp_path, "street")
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {"street": "disk full"}, []))
    assert "Failed: disk full" in text
    assert "quick is best in" in text


def test_an_empty_home_gives_a_page_that_says_so(tmp_path: Path) -> None:
    _, text = _read(make_benchmark_report(tmp_path, [], {}, []))
    assert "No scene has been measured yet." in text


def test_recipes_and_seeds_stand_beside_each_other_and_baselines_once(tmp_path: Path) -> None:
    write_street(tmp_path, "street", recipe="quick", seed=0)
    write_street(tmp_path, "street", recipe="quick", seed=1)
    write_street(tmp_path, "street", recipe="smoke", seed=0)
    page, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    for label in ("quick, seed 0", "quick, seed 1", "smoke, seed 0"):
        assert label in text
    table = page[page.index("Error beside time") :].split("</table>")[0]
    assert table.count(">copy_nearest</td>") == 1


def test_a_recipe_is_the_best_by_the_mean_over_its_seeds_not_by_the_luckiest_of_them(tmp_path: Path) -> None:
    # All errors of `smoke` are 0.03; those of the seeds of `quick` are 0.02 and 0.08.
    for recipe, seed, worse_by in (("smoke", 0, 0.0), ("quick", 0, -0.01), ("quick", 1, 0.05)):
        path = write_street(tmp_path, "street", recipe=recipe, seed=seed).path(
            f"scene_metrics/{recipe}/{seed}"
        )
        rows = [
            row | {"value": row["value"] + (-worse_by if is_likeness(row["metric"]) else worse_by)}
            if row["recipe"] == recipe
            else row
            for row in read_rows(path / "metrics.parquet")
        ]
        write_rows(path / "metrics.parquet", rows, COLUMNS)
    page, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "smoke is best in 9 of 9 main numbers at the held-out frames (quick in 0, reproject" in text
    summary = page[page.index("All scenes") :].split("</table>")[0]
    assert re.findall(r"<b>(\w+)</b></td><td>(\d)</td>.*?(\d of 9)", summary) == [
        ("quick", "0", "0 of 9"), ("quick", "1", "0 of 9"), ("smoke", "0", "9 of 9"),
    ]  # fmt: skip


def test_a_recipe_that_shows_what_a_baseline_shows_is_level_with_it_and_not_the_best(tmp_path: Path) -> None:
    path = write_street(tmp_path, "street").path("scene_metrics/quick/0") / "metrics.parquet"
    rows = read_rows(path)
    same = [row | {"recipe": "reproject", "seed": 0} for row in rows if row["recipe"] == "quick"]
    write_rows(path, [row for row in rows if row["recipe"] != "reproject"] + same, COLUMNS)
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "quick is best in 0 of 9 main numbers at the held-out frames (reproject in 0," in text
    assert "; it shows what reproject shows: level in 9." in text


def test_a_run_at_other_held_out_frames_is_named_and_compared_with_nothing(tmp_path: Path) -> None:
    write_street(tmp_path, "street", recipe="quick", seed=0)
    store = write_street(tmp_path, "street", recipe="smoke", seed=0)
    older = store.path("scene_metrics/quick/0")
    rows = [row | {"frame": row["frame"] + 1} for row in read_rows(older / "metrics.parquet")]
    write_rows(older / "metrics.parquet", rows, COLUMNS)
    _say(older, made_s=1e9)
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "Left out of the tables: quick , seed 0 (2001-09-09); measured at other held-out frames" in text
    assert "smoke is best in 9 of 9" in text and "quick in" not in text


@pytest.mark.parametrize(("frames", "is_left_out"), [("a", False), ("b", True)])
def test_what_runs_were_measured_against_is_known_by_content(
    tmp_path: Path, frames: str, is_left_out: bool
) -> None:
    for recipe, content in (("quick", "a"), ("smoke", frames)):
        store = write_street(tmp_path, "street", recipe=recipe, seed=0)
        path = store.path(f"scene_metrics/{recipe}/0") / "stage.json"
        facts = {"inputs": {"frames": content, "sweeps": "s", "novel_views": recipe}}
        path.write_text(json.dumps(json.loads(path.read_text()) | {"facts": facts}))
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert ("Left out of the tables: quick" in text) == is_left_out


def test_a_view_that_was_another_one_under_the_same_name_is_named_and_in_no_table(tmp_path: Path) -> None:
    for recipe, shift_m in (("quick", 1.0), ("lean", 4.0), ("smoke", 4.0)):
        store = write_street(tmp_path, "street", recipe=recipe)
        add_view(store, f"{recipe}/0", "shift_1m", shift_m)
    page, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "Views left out of the tables: shift_1m of quick , seed 0 (20" in text
    assert "shift_1m of lean" not in text and "quick in 9" in text, "held-out frames compare all the same"
    table = page.split("<h3>View <code>shift_1m")[1].split("</table>")[0]
    assert ">smoke</td>" in table and ">lean</td>" in table and ">quick</td>" not in table
    assert table.count(">copy_nearest</td>") == 1 and ">14.80<" in table and ">17.80<" not in table


def test_a_view_that_was_made_anew_since_it_was_measured_is_not_known(tmp_path: Path) -> None:
    for recipe in ("quick", "smoke"):
        add_view(write_street(tmp_path, "street", recipe=recipe), f"{recipe}/0", "shift_1m", 1.0)
    older = tmp_path / "street/novel_views/quick/0/stage.json"
    older.write_text(json.dumps(json.loads(older.read_text()) | {"files": {".": {"model": "another"}}}))
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "Views left out of the tables: shift_1m of quick" in text


def test_which_run_is_the_newest_and_its_age_are_a_copied_home_s_too(tmp_path: Path) -> None:
    for recipe, made_s in (("quick", 1e9), ("lean", 9e8)):
        store = write_street(tmp_path, "street", recipe=recipe)
        _say(store.path(f"scene_metrics/{recipe}/0"), made_s=made_s)
    for place, made_s in (("0-0-manual", 1e9), ("0-7-2026-W47", 9e8)):
        check = {"name": "every_scan_has_returns", "passed": False, "detail": f"in {place}"}
        _say(store.path("dataset/.index/quick") / place, made_s=made_s, checks=[check])
    copied_last = sorted(tmp_path.rglob("*.*"), key=lambda path: "lean" in str(path) or "W47" in str(path))
    for number, path in enumerate(copied_last):
        os.utime(path, (2e9 + number, 2e9 + number))
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "Measured: quick , seed 0: commit abc , 2001-09-09 01:46 UTC" in text
    assert "in 0-0-manual" in text and "in 0-7-2026-W47" not in text


def _say(folder: Path, **facts: object) -> None:
    """Add facts to a stage's record; one that is not there is made."""
    path = folder / "stage.json"
    folder.mkdir(parents=True, exist_ok=True)
    found = json.loads(path.read_text()) if path.is_file() else record_of_output()
    path.write_text(json.dumps(found | facts))


def test_a_doubt_of_the_newest_run_s_data_set_is_no_older_run_s(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street", recipe="quick", seed=0)
    record = json.loads((store.path("novel_views/quick/0") / "stage.json").read_text())
    for place, detail in (("0-0-manual", "views with an empty scan: left"), ("1-7-2026-W47", "of seed 1")):
        folder = store.path("dataset") / ".index" / "quick" / place
        folder.mkdir(parents=True)
        check = {"name": "every_scan_has_returns", "passed": False, "detail": detail}
        (folder / "stage.json").write_text(json.dumps(record | {"checks": [check]}))
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "2 of 2 checks raise a doubt" in text, "of the views and of the data set of seed 0"
    shown, older = text.split("Checks of the older runs")
    assert "dataset quick 0 every scan has returns" in shown and "dataset quick 1" in older


def test_the_page_holds_what_earlier_runs_measured_and_says_where_each_row_is_from(tmp_path: Path) -> None:
    write_street(tmp_path, "street", recipe="quick", seed=3)
    write_street(tmp_path, "avenue", recipe="smoke", seed=0)
    killed = tmp_path / "lane" / "scene_metrics" / "quick" / ".publishing-0-1-abc"
    killed.mkdir(parents=True)
    (killed / "metrics.parquet").write_bytes(b"half")
    page, text = _read(make_benchmark_report(tmp_path, ["avenue"], {}, ["street", "kitti360_1908"]))
    assert page.index('<section id="avenue">') < page.index('<section id="street">')
    assert "lane" not in page
    summary = page[page.index("All scenes") :].split("</table>")[0]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in summary.split("<tr>")[2:]]
    assert [(row[1], row[2]) for row in rows if row[2]] == [("<b>smoke</b>", "0"), ("<b>quick</b>", "3")]
    assert len(rows) == 8 and all(">abc<" in row[-2] and row[-1].startswith("20") for row in rows)
    assert "these scenes of the catalogue: kitti360_1908 ." in text
    assert "Measured: quick , seed 3: commit abc" in text and "UTC, on a machine of 2 cores" in text


def test_what_an_earlier_run_left_unreadable_is_named_and_costs_no_page(tmp_path: Path) -> None:
    write_street(tmp_path, "street")
    store = write_street(tmp_path, "old")
    array = store.path("novel_views/quick/0") / "test" / "model.zarr" / "points_m"
    array.rename(array.with_name("lost"))
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "old failed: what was published cannot be read" in text and "points_m" in text
    assert "quick is best in" in text


def test_a_page_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_street(tmp_path, "street")
    before = make_benchmark_report(tmp_path, ["street"], {}, []).read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "index.html")

    monkeypatch.setattr(benchmark_report, "write_report", full)
    with pytest.raises(StoreError, match="No space left"):
        make_benchmark_report(tmp_path, ["street"], {"street": "out of memory"}, [])
    assert (tmp_path / "benchmark_report" / "index.html").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".publishing")] == []


def test_a_page_is_made_again_only_where_something_that_it_is_made_from_changed(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street")
    page = make_benchmark_report(tmp_path, ["street"], {}, [])
    first = page.stat().st_ino
    assert make_benchmark_report(tmp_path, ["street"], {}, []).stat().st_ino == first
    record = store.path("scene_metrics/quick/0") / "stage.json"
    record.write_text(record.read_text() + "\n")
    second = make_benchmark_report(tmp_path, ["street"], {}, []).stat().st_ino
    assert second != first
    (tmp_path / "benchmark_report" / "made_from.sha256").unlink()
    assert make_benchmark_report(tmp_path, ["street"], {}, []).stat().st_ino != second


def test_a_scene_of_this_run_that_cannot_be_read_is_named_and_costs_no_page(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street")
    (store.path("field/quick/0") / "curve.parquet").unlink()
    for array in ("pano_range_m", "points_m"):
        folder = store.path("novel_views/quick/0") / "test" / "model.zarr" / array
        folder.rename(folder.with_name(f"lost_{array}"))
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "street failed: what was published cannot be read" in text
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".publishing")] == []


def test_a_name_that_can_be_no_folder_s_costs_no_page(tmp_path: Path) -> None:
    write_street(tmp_path / "home", "street")
    page, text = _read(make_benchmark_report(tmp_path / "home", ["street", "../x"], {"../x": "no such"}, []))
    assert "../x failed:" in text and "no such" in text and 'id="street"' in page


def test_failures_of_earlier_runs_are_shown_until_the_stage_succeeds(tmp_path: Path) -> None:
    store = write_street(tmp_path, "street")
    new = SceneStore(tmp_path, "avenue")
    for one in (store, new):
        remember_failure(one, "field", "it diverged")
        remember_failure(one, "frames", "the scan is <torn>")
    page, text = _read(make_benchmark_report(tmp_path, [], {"street": "out of memory"}, []))
    assert page.index("frames: the scan is &lt;torn&gt; (20") < page.index("field: it diverged (20")
    assert "avenue failed:" in text and "street failed: out of memory" in text
    forget_failure(store, "frames")
    forget_failure(store, "field")
    remember_failure(store, "field/large/0", "it was too large")
    forget_failure(store, "field/lean/0")
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "field large 0: it was too large" in text and "if it is settled, remove" in text
    forget_failure(store, "field/large/0")
    (new.path(".failed") / "frames.json").write_text("half")
    _, text = _read(make_benchmark_report(tmp_path, ["street"], {}, []))
    assert "street failed" not in text and "frames: failed; why cannot be read" in text
