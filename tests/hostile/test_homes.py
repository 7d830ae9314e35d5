"""Homes with something wrong in them: made anew where it is needed, or refused by name. One row a case."""

import base64
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import NvsfError, StoreError
from nvsf_core.metrics.table import COLUMNS
from nvsf_core.reporting.error_cloud import ERROR_CLOUD_NAME
from nvsf_core.reporting.scene_outputs import measured_scenes
from nvsf_core.stages import SceneRun, plan_run, run_named_stage
from nvsf_core.stages.benchmark_report import make_benchmark_report
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.locks import device_lock, lock_file
from nvsf_core.stages.runner.record import read_record
from nvsf_core.stages.runner.trained import newest_field
from nvsf_core.stores.arrays import read_arrays, write_arrays
from nvsf_core.stores.checkpoints import StoredWeights, save_tensors
from nvsf_core.stores.scene_store import SceneStore, publish_folder
from nvsf_core.stores.tables import read_rows, write_rows
from tests.hostile import harm
from tests.reporting.street_store import write_street

STAGES = ("frames", "sweeps", "pano", "undistorted", "evidence")
FRAMES, CAMERAS, DRIVE = "frames/frames.parquet", "frames/cameras.parquet", "frames/drive.json"
RETURNS, IMAGES = "sweeps/returns.zarr", "undistorted/images.zarr"


@pytest.fixture(scope="module")
def made(tiny_catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home whose scene `tiny` was prepared up to its evidence."""
    home = tmp_path_factory.mktemp("made") / "home"
    _prepare(_plan(tiny_catalogue, home))
    return home


@pytest.fixture
def run(made: Path, tiny_catalogue: Path, tmp_path: Path) -> SceneRun:
    shutil.copytree(made, tmp_path / "home")
    return _plan(tiny_catalogue, tmp_path / "home")


def _plan(catalogue: Path, home: Path) -> SceneRun:
    entry = next(entry for entry in load_catalogue([catalogue], None) if entry.name == "tiny")
    return plan_run(entry, home, recipe="smoke")


def _prepare(run: SceneRun) -> list[str]:
    """Run the stages; names of those that were not skipped."""
    outcomes = [run_named_stage(stage, run, lambda line: None) for stage in STAGES]
    return [outcome.stage for outcome in outcomes if not outcome.skipped]


def _first_chunk(group: Path) -> Path:
    """The largest array's first chunk."""
    return max((path for path in group.rglob("*") if "/c/" in str(path) and path.is_file()),
               key=lambda path: path.stat().st_size)  # fmt: skip


def _zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def _other_values(path: Path) -> None:
    """Another table of the same columns."""
    rows = [row | {"time_s": row["time_s"] + 1.0} for row in read_rows(path)]
    write_rows(path, rows, list(rows[0]))


HEALED: list[tuple[str, str, Callable[[Path], None], list[str]]] = [
    *(
        (f"{what} {name}", name, done, [name.split("/")[0]])
        for name in (
            "frames/stage.json",
            FRAMES,
            CAMERAS,
            DRIVE,
            f"{RETURNS}/zarr.json",
            "pano/stage.json",
        )
        for what, done in (("cut", harm.cut), ("empty", harm.empty), ("no", harm.remove))
    ),
    ("a list for a record", "pano/stage.json", harm.text("[1, 2]"), ["pano"]),
    ("a foreign record", "pano/stage.json", harm.text('{"fingerprint": "1"}'), ["pano"]),
    ("brackets for a record", "pano/stage.json", harm.text("[" * 100_000), ["pano"]),
    ("a folder for a record", "pano/stage.json", harm.folder, ["pano"]),
    ("a folder for a table", FRAMES, harm.folder, ["frames"]),
    ("a pipe for a table", FRAMES, harm.pipe, ["frames"]),
    ("another table", FRAMES, _other_values, ["frames"]),
    ("a flipped bit in a table", FRAMES, harm.flip, ["frames"]),
    ("a flipped bit in metadata", f"{RETURNS}/range_m/zarr.json", harm.flip, ["sweeps"]),
    ("a flipped bit in a chunk", "chunk", harm.flip, ["sweeps"]),
    ("a chunk of zeros", "chunk", _zeros, ["sweeps"]),
    ("a missing chunk", "chunk", harm.remove, ["sweeps"]),
    ("a missing picture", "frames/path.png", harm.remove, []),
    ("a file for a stage", "pano", lambda path: (shutil.rmtree(path), path.write_text("1"))[0], ["pano"]),
    ("a foreign file beside", "pano/notes.txt", lambda path: path.write_text("mine") and None, []),
]


@pytest.mark.parametrize(("name", "done", "again"), [c[1:] for c in HEALED], ids=[c[0] for c in HEALED])
def test_a_damaged_output_is_made_again_and_nothing_else(
    run: SceneRun, made: Path, name: str, done: Callable[[Path], None], again: list[str]
) -> None:
    path = _first_chunk(run.store.path(RETURNS)) if name == "chunk" else run.store.root / name
    done(path)
    assert _prepare(run) == again
    assert _prepare(run) == []
    for group in (RETURNS, IMAGES, "evidence/evidence.zarr"):
        before, after = read_arrays(made / "tiny" / group), read_arrays(run.store.path(group))
        assert before.keys() == after.keys()
        assert all(np.array_equal(before[key], after[key], equal_nan=True) for key in before)


READ = [
    (
        "a missing chunk",
        lambda store: harm.remove(_first_chunk(store.path(RETURNS))),
        "expected . chunks, found 0",
    ),
    ("a flipped bit", lambda store: harm.flip(_first_chunk(store.path(RETURNS))), "damaged"),
    ("a chunk of zeros", lambda store: _zeros(_first_chunk(store.path(IMAGES))), "damaged"),
    ("a cut group", lambda store: harm.cut(store.path(RETURNS) / "zarr.json"), "damaged"),
    (
        "arrays of another type",
        lambda store: _retyped(store.path(RETURNS)),
        "range_m: expected type f4, found f8",
    ),
    ("an absent array", lambda store: shutil.rmtree(store.path(RETURNS) / "range_m"), "range_m"),
    (
        "an array beyond memory",
        lambda store: _claims(store.path(RETURNS)),
        "range_m: expected 5333333334 chunks, found 1",
    ),
    ("a cut table", lambda store: harm.cut(store.path(FRAMES)), "frames.parquet.*damaged"),
    (
        "a table of other columns",
        lambda store: write_rows(store.path(FRAMES), [{"a": 1}], ["a"]),
        "frames.parquet",
    ),
    (
        "a table of other types",
        lambda store: _texts(store.path(FRAMES)),
        "column frame: expected i8, found string",
    ),
    (
        "a pipe for a chunk",
        lambda store: harm.pipe(_first_chunk(store.path(RETURNS))),
        "expected regular files",
    ),
    (
        "a device for metadata",
        lambda store: harm.endless(store.path(RETURNS) / "zarr.json"),
        "expected regular files",
    ),
    (
        "a chunk of 3 GB",
        lambda store: harm.sparse(3)(_first_chunk(store.path(RETURNS))),
        "expected chunks of",
    ),
    (
        "a foreign array without chunks",
        lambda store: _foreign(store.path(RETURNS)),
        "expected 1 chunks, found 0",
    ),
    ("no origin", lambda store: store.path(DRIVE).write_text("{}"), "drive.json: expected 'scene_to_world'"),
]


def _retyped(group: Path) -> None:
    arrays = dict(read_arrays(group))
    write_arrays(group, arrays | {"range_m": arrays["range_m"].astype(np.float64)})


def _claims(group: Path) -> None:
    facts = json.loads((group / "range_m" / "zarr.json").read_text())
    (group / "range_m" / "zarr.json").write_text(json.dumps(facts | {"shape": [10**13]}))


def _foreign(group: Path) -> None:
    stored = zarr.open_group(str(group), mode="a")
    stored.create_array("foo", shape=(10,), dtype="f4", chunks=(10,))


def _texts(path: Path) -> None:
    rows = [row | {"frame": str(row["frame"])} for row in read_rows(path)]
    write_rows(path, rows, list(rows[0]))


@pytest.mark.parametrize(("done", "words"), [case[1:] for case in READ], ids=[case[0] for case in READ])
def test_who_reads_a_damaged_output_is_told_what_to_delete(
    run: SceneRun, done: Callable[[SceneStore], None], words: str
) -> None:
    done(run.store)
    with pytest.raises(StoreError, match=rf"(?s)({words}).*delete .* run again"):
        recording = read_recording(run.store)
        recording.lidar.sweeps.arrays["range_m"]


def test_a_flipped_bit_anywhere_in_a_table_never_becomes_a_value(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    write_rows(path, [{"a": k, "b": f"{k}", "c": [0.5 * k]} for k in range(30)], ["a", "b", "c"])
    whole, rows = path.read_bytes(), read_rows(path)
    refused = 0
    for position in range(0, len(whole), 3):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x10]) + whole[position + 1 :])
        try:
            # A name may change; who asks for the column is then told that it is not there.
            for found, true in zip(read_rows(path), rows, strict=True):
                assert all(found.get(name, value) == value for name, value in true.items()), position
        except StoreError:
            refused += 1
    assert refused > 0.1 * len(whole) / 3


@pytest.mark.parametrize("harmed", ["chunk", "stage.json"])
def test_a_stage_never_reads_an_input_that_is_not_what_was_published(run: SceneRun, harmed: str) -> None:
    content = _first_chunk(run.store.path(RETURNS)).read_bytes()
    path = _first_chunk(run.store.path(RETURNS)) if harmed == "chunk" else run.store.path("sweeps") / harmed
    harm.flip(path) if harmed == "chunk" else harm.cut(path)
    shutil.rmtree(run.store.path("pano"))
    said: list[str] = []
    run_named_stage("pano", run, said.append)
    assert any("pano: its input sweeps is made again first" in line for line in said), said
    assert _first_chunk(run.store.path(RETURNS)).read_bytes() == content
    assert _prepare(run) == []


@pytest.mark.parametrize("part", ["metadata", "previews", "checks", "files"])
def test_a_record_of_other_kinds_counts_as_absent(run: SceneRun, part: str) -> None:
    path = run.store.path("frames") / "stage.json"
    record = json.loads(path.read_text())
    for wrong in ([["a"]], {"a": None}, {"a": "../../x"} if part == "previews" else 7):
        path.write_text(json.dumps(record | {part: wrong}))
        assert read_record(path.parent) is None


def test_leftovers_of_killed_writers_are_ignored_and_others_are_not_taken_for_them(tmp_path: Path) -> None:
    store = SceneStore(home=tmp_path, scene="s")
    for name in (".publishing-0-99999999-0123abcd", ".publishing-0-odd-name", ".retired-0-0123abcd"):
        folder = store.root / "field" / "lean" / name
        folder.mkdir(parents=True)
        (folder / "stage.json").write_text("{}")
    assert newest_field(store.root) is None
    assert make_benchmark_report(tmp_path, [], {}, []).is_file()
    # Those of `left-2` begin like those of `left`.
    with store.publish("dataset/left-2") as folder:
        (folder / "kept").write_text("1")
    store.path("dataset/left-2").rename(store.root / "dataset" / ".retired-left-2-0123abcd")
    with publish_folder(store.path("dataset/left")) as folder:
        (folder / "other").write_text("1")
    assert [path.name for path in store.path("dataset/left").iterdir()] == ["other"]
    with pytest.raises(ZeroDivisionError), store.publish("dataset/left-2"):
        raise ZeroDivisionError
    assert (store.path("dataset/left-2") / "kept").is_file()


def test_weights_of_another_network_are_refused_by_name(tmp_path: Path) -> None:
    path, network = tmp_path / "weights.safetensors", torch.nn.Linear(2, 3)
    state = {f"net.{name}": value for name, value in network.state_dict().items()}
    wrong = (
        {"net.weight": torch.zeros(3, 2)},
        state | {"net.weight": torch.zeros(4, 2)},
        state | {"net.bias": torch.full((3,), float("nan"))},
        {"other.weight": torch.zeros(3, 2)},
    )
    for tensors in wrong:
        save_tensors(path, tensors)
        with pytest.raises(StoreError, match=rf"(?s){path.name}: expected .*delete .* run again"):
            StoredWeights.read(path).load_into(network, "net.")


def test_one_scene_that_cannot_be_read_costs_no_other_its_place_in_the_report(tmp_path: Path) -> None:
    for name in ("torn", "empty"):
        folder = tmp_path / name / "scene_metrics" / "lean" / "0"
        folder.mkdir(parents=True)
        (folder / "metrics.parquet").write_bytes(b"PAR1" if name == "torn" else b"")
    page = make_benchmark_report(tmp_path, ["torn"], {}, []).read_text()
    assert page.count("cannot be read") >= 2 and "metrics.parquet" in page


def test_a_link_from_one_output_to_another_is_refused(run: SceneRun) -> None:
    shutil.rmtree(run.store.path("pano"))
    (run.store.root / "pano").symlink_to(run.store.root / "sweeps")
    with pytest.raises(StoreError, match="is a link"):
        run_named_stage("pano", run, lambda line: None)
    assert (run.store.path(RETURNS)).is_dir()


def test_an_output_whose_writer_died_between_two_renames_is_put_back_and_not_made_again(
    run: SceneRun,
) -> None:
    run.store.path("frames").rename(run.store.root / ".retired-frames-0123abcd")
    assert _prepare(run) == []


@pytest.mark.parametrize("harmed", [{"seconds": 10**400}, {"seconds": True}, {"metadata": {"a": "\ud800"}},
                                    {"previews": {"a": "b" * 5000}}, {"files": {"\ud800": {}}}])  # fmt: skip
def test_a_record_that_no_page_can_show_is_healed(run: SceneRun, harmed: dict[str, Any]) -> None:
    path = run.store.path("frames") / "stage.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | harmed))
    assert _prepare(run) == ["frames"]


def test_numbers_that_no_plot_can_draw_cost_no_other_scene_its_page(tmp_path: Path) -> None:
    for name in ("street", "absurd"):
        store = write_street(tmp_path, name)
    table = store.path("scene_metrics/quick/0") / "metrics.parquet"
    write_rows(table, [row | {"train_seconds": 1e308, "value": 1e308} for row in read_rows(table)], COLUMNS)
    page = make_benchmark_report(tmp_path, ["street", "absurd"], {}, []).read_text()
    assert 'id="absurd"' in page and "is best in" in page.split('id="street"')[1]


def test_metrics_of_another_scene_are_not_shown_as_this_ones(tmp_path: Path) -> None:
    write_street(tmp_path, "street").root.rename(tmp_path / "other")
    page = make_benchmark_report(tmp_path, ["other"], {}, []).read_text()
    assert "expected metrics of scene" in page and "is best in" not in page


def test_a_link_is_no_picture_and_no_scene(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("a private word")
    store = write_street(tmp_path / "home", "street")
    cloud = store.path("scene_metrics/quick/0") / ERROR_CLOUD_NAME
    cloud.unlink(missing_ok=True)
    cloud.symlink_to(secret)
    (tmp_path / "home" / "linked").symlink_to(store.root)
    page = make_benchmark_report(tmp_path / "home", ["street"], {}, []).read_text()
    assert base64.b64encode(b"a private word").decode() not in page
    assert measured_scenes(tmp_path / "home") == ["street"]


@pytest.mark.parametrize("name", ["\u0663", "007", "9" * 200, "none"])
def test_only_a_seeds_own_folder_is_a_field(tmp_path: Path, run: SceneRun, name: str) -> None:
    for recipe, folder in (("lean", name), ("no_such_recipe", "0")):
        place = tmp_path / "s" / "field" / recipe / folder
        place.mkdir(parents=True)
        shutil.copy(run.store.path("frames") / "stage.json", place)
    assert newest_field(tmp_path / "s") is None


@pytest.mark.parametrize("done", [Path.mkdir, os.mkfifo])
def test_what_takes_the_locks_place_is_named(tmp_path: Path, done: Callable[[Path], None]) -> None:
    (tmp_path / "locks").mkdir()
    done(lock_file(tmp_path / "locks"))
    refused = pytest.raises(StoreError, match=r"cpu-\w+\.lock: expected a lock file")
    with refused, device_lock(tmp_path / "locks", lambda line: None):
        pass


@pytest.mark.parametrize(("stage", "file"), [("undistorted", "image_path"), ("sweeps", "scan_path")])
def test_what_changed_after_it_was_validated_is_refused(
    made: Path, tiny_catalogue: Path, tmp_path: Path, stage: str, file: str
) -> None:
    shutil.copytree(tiny_catalogue.parent / "drive", tmp_path / "drive")
    shutil.copytree(made, tmp_path / "home")
    entry = replace(load_catalogue([tiny_catalogue], None)[0], root=tmp_path / "drive")
    run = plan_run(entry, tmp_path / "home", recipe="smoke")
    layout = DriveLayout(entry.root, entry.sequence)
    one, other = (
        (layout.image_path("image_00", k) if file == "image_path" else layout.scan_path(k)) for k in (0, 1)
    )
    shutil.copy(one, other)
    shutil.rmtree(run.store.path(stage))
    with pytest.raises(NvsfError, match="changed since the stage `frames` validated it"):
        run_named_stage(stage, run, lambda line: None)


def test_links_in_a_circle_are_named(run: SceneRun) -> None:
    shutil.rmtree(run.store.root / "frames")
    (run.store.root / "frames").symlink_to(run.store.root / "frames")
    with pytest.raises(NvsfError, match="in a circle"):
        run_named_stage("sweeps", run, lambda line: None)
