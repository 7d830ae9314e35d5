"""A stated number of versions of each data set is kept; a removed one is noted, and never half there."""

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from assets.metadata import exported_folders
from nvsf_core.errors import DataError
from nvsf_core.stages import STAGES, SceneRun, plan_run, run_named_stage
from nvsf_core.stages.exports.manifest import write_manifest
from nvsf_core.stages.flow import WORK_MODULES
from nvsf_core.stages.runner.locks import file_lock
from nvsf_core.stages.runner.stage import Outcome
from nvsf_core.stages.runner.verify import Verdict, verify_scene
from nvsf_core.stages.scene_records import stage_records
from nvsf_core.stages.versions import (
    damage_at_rest,
    damage_of_version,
    make_anew,
    reading_versions,
    versions_lock,
    versions_of,
)
from nvsf_core.stages.versions_page import write_versions_page
from nvsf_core.stores.documents import read_document, write_document
from nvsf_core.stores.removal import KEEP_VARIABLE, number_kept, removal_of, removals
from pipelines.cli import main
from tests.records import record_of_output
from tests.stages.test_dataset import _task

VIEWS = ("shift_1m", "test")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with the inputs of the stage `dataset`, as their stages record them."""
    home = tmp_path_factory.mktemp("prepared")
    store = _task(home).store
    for place in ("frames", "evidence", "novel_views/quick/0", "scene_metrics/quick/0"):
        write_document(store.path(place) / "stage.json", record_of_output(fingerprint=place))
    return home


@pytest.fixture
def home(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "home")
    return tmp_path / "home"


def _plan(home: Path, draw: int) -> SceneRun:
    scene = replace(_task(home).scene, root=home.parent / "drive")
    return plan_run(scene, home, recipe="quick", draw_seed=draw, dataset_label=f"W{draw}")


def _make(home: Path, draw: int, said: list[str] | None = None) -> Outcome:
    return run_named_stage("dataset", _plan(home, draw), (said if said is not None else []).append)


def _labels(home: Path, view: str = "test") -> list[str]:
    found = [one for one in versions_of(_plan(home, 0).store) if one.view == view]
    assert [damage_of_version(one) for one in found] == [None] * len(found)
    return sorted(one.name.partition("-")[0] for one in found)


def _folder(home: Path, label: str, view: str = "test") -> Path:
    (folder,) = (home / "tiny/dataset" / view).glob(f"{label}-*")
    return folder


def _is_whole(home: Path, *draws: int) -> bool:
    """Whether the records of all runs, and what is left of them, are as published."""
    hidden = [path for path in (home / "tiny").rglob(".*") if path.name.startswith(".removing-")]
    verdicts = [
        one.verdict for draw in draws for one in verify_scene(_plan(home, draw), STAGES)
        if one.stage == "dataset"
    ]  # fmt: skip
    return not hidden and verdicts == [Verdict.UP_TO_DATE] * len(draws)


def test_all_versions_are_kept_unless_a_number_is_stated(home: Path) -> None:
    for draw in range(3):
        _make(home, draw)
    assert _labels(home) == ["W0", "W1", "W2"] and not (home / "tiny/.removed").exists()


def test_the_newest_ones_are_kept_and_the_others_are_noted(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "2")
    said: list[str] = []
    for draw in range(4):
        _make(home, draw, said)
        assert _is_whole(home, *range(draw + 1))
    for view in VIEWS:
        assert _labels(home, view) == ["W2", "W3"]
    notes = list(removals(_plan(home, 0).store, "dataset/*/*"))
    assert [(one.place.split("/")[1], one.place.split("/")[2][:2]) for one in notes] == [
        (view, label) for view in VIEWS for label in ("W0", "W1")
    ]
    assert {one.rule for one in notes} == {"NVSF_KEEP_VERSIONS=2"}
    assert sum("removed by NVSF_KEEP_VERSIONS=2" in line for line in said) == 4
    again: list[str] = []
    assert _make(home, 0, again).skipped, "what was removed is not made anew"
    assert _labels(home) == ["W2", "W3"] and any(f"delete {notes[0].note}" in line for line in again)


def test_a_version_that_a_run_is_writing_at_is_no_damage_and_one_at_rest_is(home: Path) -> None:
    _make(home, 0)
    store = _plan(home, 0).store
    version = next(one for one in versions_of(store) if one.view == "test")
    card, aside = version.folder / "card.json", home / "aside"
    card.rename(aside)
    said: list[str] = []
    with contextlib.ExitStack() as writer:
        index = versions_lock(store).parent / "dataset/.index/quick/0-0-W0.lock"
        writer.enter_context(file_lock(index, str, ""))

        def end(line: str) -> None:
            said.append(line)
            aside.rename(card)
            writer.close()

        assert damage_at_rest(store, version, end) is None
    assert said == ["waiting for data sets of tiny, which another run writes (0 s)"]
    card.unlink()
    assert damage_at_rest(store, version, said.append) == str(card) and len(said) == 1


def test_a_version_that_asks_for_something_else_is_another_views(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    _make(home, 0)
    folder = _folder(home, "W0", "shift_1m")
    manifest = read_document(folder / "manifest.json")
    manifest.pop("manifest_sha256")
    write_manifest(folder, {**manifest, "view": {**manifest["view"], "shift_m": [0.0, 2.0, 0.0]}})
    _make(home, 1)
    _make(home, 2)
    assert _labels(home, "shift_1m") == ["W0", "W2"] and _labels(home) == ["W2"]


def test_what_copies_and_clocks_do_to_times_does_not_decide_which_is_the_oldest(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for draw in range(3):
        _make(home, draw)
        os.utime(_folder(home, f"W{draw}") / "manifest.json", (4e9 - draw, 4e9 - draw))
    monkeypatch.setenv(KEEP_VARIABLE, "2")
    _make(home, 3)
    assert _labels(home) == ["W2", "W3"]


def test_a_pinned_version_is_kept_and_stays_pinned_when_it_is_mended(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    _make(home, 0)
    (_folder(home, "W0") / "PINNED").touch()
    for draw in (1, 2):
        _make(home, draw)
    assert _labels(home) == ["W0", "W2"] and _labels(home, "shift_1m") == ["W2"]
    (_folder(home, "W0") / "card.md").write_text("another")
    (damaged,) = [one for one in versions_of(_plan(home, 0).store) if damage_of_version(one)]
    assert make_anew(_plan(home, 0).scene, home, damaged, str)
    assert (_folder(home, "W0") / "PINNED").exists()
    assert _labels(home) == ["W0", "W2"] and _labels(home, "shift_1m") == ["W2"], "only what was damaged"
    (_folder(home, "W0") / "PINNED").unlink()
    assert _is_whole(home, 0, 1, 2)
    _make(home, 3)
    assert _labels(home) == ["W3"] and _is_whole(home, 0, 1, 2, 3)


def test_versions_of_another_seed_are_counted_apart(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _make(home, 0)
    store = _plan(home, 0).store
    for place in ("novel_views/quick", "scene_metrics/quick"):
        shutil.copytree(store.path(f"{place}/0"), store.path(f"{place}/1"))
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    run = plan_run(_plan(home, 1).scene, home, recipe="quick", seed=1, dataset_label="other")
    run_named_stage("dataset", run, str)
    _make(home, 1)
    assert _labels(home) == ["W1", "other"]


def test_a_removed_version_is_made_anew_once_its_note_is_deleted(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    _make(home, 0)
    before = {path.name: path.read_bytes() for path in _folder(home, "W0").rglob("*.bin")}
    _make(home, 1)
    store = _plan(home, 0).store
    for note in removals(store, "dataset/test/*"):
        note.note.unlink()
    assert not _is_whole(home, 0), "lost, for all that anybody knows"
    assert not _make(home, 0).skipped
    assert {path.name: path.read_bytes() for path in _folder(home, "W0").rglob("*.bin")} == before
    assert _labels(home) == ["W0"] and _labels(home, "shift_1m") == ["W1"] and _is_whole(home, 0, 1)


def test_a_version_that_somebody_reads_is_not_removed(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    _make(home, 0)
    said: list[str] = []
    with reading_versions(home, ["tiny"], str):
        _make(home, 1, said)
        assert _labels(home) == ["W0", "W1"]
        assert "[tiny] dataset: read by another run, so none is removed by this one" in said
    _make(home, 1)
    assert _labels(home) == ["W1"]


def test_a_run_waits_for_who_removes_versions(home: Path) -> None:
    from nvsf_core.stages.runner.locks import free_lock

    said: list[str] = []
    with free_lock(versions_lock(_plan(home, 0).store)) as is_held:
        assert is_held
        run = threading.Thread(target=_make, args=(home, 0, said))
        run.start()
        while not any("waiting for dataset" in line for line in said):
            run.join(0.02)
            assert run.is_alive(), "it waits for nobody"
        assert _labels(home) == []
    run.join()
    assert _labels(home) == ["W0"]


def _die(home: Path, number: int, event: str, words: str) -> None:
    """Run in a process of its own, and end it by SIGKILL just before it asks the system for something."""
    os.environ[KEEP_VARIABLE] = str(number)

    def die(name: str, arguments: tuple[object, ...]) -> None:
        if name == event and any(words in str(one) for one in arguments):
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(die)
    _make(home, 2)


def _killed(*arguments: object) -> bool:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, *WORK_MODULES])
    child = context.Process(target=_die, args=arguments)
    child.start()
    child.join()
    return child.exitcode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("event", "words", "is_noted"),
    [
        ("os.rename", ".removed/dataset/shift_1m/W", False),
        ("os.rename", ".removing-", True),
        ("shutil.rmtree", ".removing-", True),
        ("os.rmdir", "data", True),
    ],
    ids=["before the note", "before it is taken away", "before it is deleted", "half deleted"],
)
def test_a_process_that_dies_while_it_removes_loses_nothing(
    home: Path, monkeypatch: pytest.MonkeyPatch, event: str, words: str, is_noted: bool
) -> None:
    for draw in range(3):
        _make(home, draw)
    assert _killed(home, 1, event, words)
    assert (home / "tiny/.removed/dataset/shift_1m").exists() and is_noted == any(
        (home / "tiny/.removed/dataset/shift_1m").glob("W0*.json")
    )
    store = _plan(home, 0).store
    assert any((home / "tiny/.removed").rglob(".publishing-*")) != is_noted, "half a note"
    left = {one.location for one in versions_of(store) if damage_of_version(one) is None}
    gone = {one.place for one in removals(store, "dataset/*/*")}
    assert len(left) + len(gone) == 6 and not left & gone, "each is whole or noted"
    assert not any((home / "tiny/.removed").rglob(".publishing-*")), "a reader removes it"
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    _make(home, 2)
    assert all(_labels(home, view) == ["W2"] for view in VIEWS) and _is_whole(home, 0, 1, 2)


def test_a_version_that_was_noted_and_is_kept_after_all_loses_its_note(home: Path) -> None:
    for draw in range(3):
        _make(home, draw)
    assert _killed(home, 2, "os.rename", ".removing-")
    (note,) = (home / "tiny/.removed/dataset").rglob("*.json")
    _make(home, 2)
    assert not note.exists() and _labels(home) == ["W0", "W1", "W2"]


def test_the_page_tells_of_removed_versions(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    for draw in range(2):
        _make(home, draw)
    page = write_versions_page(home, home, ["tiny"]).read_text()
    (note,) = removals(_plan(home, 0).store, "dataset/test/*")
    assert note.words in page and Path(note.place).name in page
    assert "draw seed 0 → 1" in page, "the newer one is still compared with it"
    assert removal_of(_plan(home, 0).store, f"dataset/test/{_folder(home, 'W1').name}") is None


def test_an_infinite_metric_stands_on_the_page_of_versions(home: Path) -> None:
    _make(home, 0)
    manifest = _folder(home, "W0") / "manifest.json"
    metric = {"protocol": "image", "metric": "image_psnr_db", "region": "all", "split": "test"}
    rows = {"field_metrics": [{**metric, "value": "inf"}]}
    write_document(manifest, json.loads(manifest.read_text()) | rows)
    assert "∞" in write_versions_page(home, home, ["tiny"]).read_text()


@pytest.mark.parametrize(
    "harm",
    [
        {"recipe": 3, "view": [], "software": "x", "field_metrics": [1, {"value": "x"}]},
        {"made_s": 1e300, "scans": -1, "megabytes": "x", "images": None, "field_metrics": {}},
    ],
)
def test_a_note_or_a_manifest_that_is_damaged_hides_no_other_version(
    home: Path, monkeypatch: pytest.MonkeyPatch, harm: dict[str, object]
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    for draw in range(3):
        _make(home, draw)
    note, _ = removals(_plan(home, 0).store, "dataset/test/*")
    write_document(note.note, json.loads(note.note.read_text()) | {"facts": dict(note.facts) | harm})
    manifest = _folder(home, "W2") / "manifest.json"
    write_document(manifest, json.loads(manifest.read_text()) | harm)
    page = write_versions_page(home, home, ["tiny"]).read_text()
    assert page.count(note.rule) == 4 and manifest.parent.name in page
    note.note.write_text('{"removed": 1}')
    assert write_versions_page(home, home, ["tiny"]).read_text().count(note.rule) == 3
    assert not _make(home, 0).skipped, "without a readable note it is lost"


def test_no_link_leads_to_a_removed_version(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    outcomes = [_make(home, draw) for draw in range(2)]
    (newest,) = stage_records(home / "tiny")[-1:]
    assert newest.stage == "dataset quick 0" and newest.metadata["test_version"] == _folder(home, "W1").name
    record = outcomes[0].path / "stage.json"
    write_document(record, json.loads(record.read_text()) | {"made_s": 4e9})
    (newest,) = stage_records(home / "tiny")[-1:]
    assert newest.metadata["test_scans"] == 1 and "test_version" not in newest.metadata
    assert [list(exported_folders(one)) for one in outcomes] == [[], ["test", "shift_1m"]]


def test_verify_names_removed_versions_and_finds_no_damage(
    home: Path, tiny_catalogue: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, "1")
    for draw in range(2):
        _make(home, draw)
    monkeypatch.setenv("NVSF_HOME", str(home))
    monkeypatch.setenv("NVSF_SCENES", str(tiny_catalogue))
    for words in (["verify", "tiny"], ["verify", "tiny", "--mend"]):
        said = CliRunner().invoke(main, words)
        assert said.exit_code == 0, said.output
        lines = said.output.splitlines()
        assert [line.rpartition(": ")[2][:10] for line in lines] == ["whole"] * 2 + ["removed on"] * 2
        assert all(line.endswith("by NVSF_KEEP_VERSIONS=1") for line in lines[2:])


@pytest.mark.parametrize("wrong", ["0", "-1", "two", "1.5"])
def test_what_is_no_number_of_versions_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: str
) -> None:
    monkeypatch.setenv(KEEP_VARIABLE, wrong)
    with pytest.raises(DataError, match=f"NVSF_KEEP_VERSIONS='{wrong}': expected a whole number of versions"):
        _plan(tmp_path, 0)
    assert number_kept({}) is None
