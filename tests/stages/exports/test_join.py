"""Data sets of a cut drive's parts become one: each frame once, of the part whose it is."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.cuts import cut_scene, parts_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.writer import read_numbers, write_grey
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.errors import DataError
from nvsf_core.stages.exports.join import asks_for, join_data_sets, newest_data_set
from nvsf_core.stages.exports.one_drive import on_one_clock
from nvsf_core.stages.exports.write import finish_data_set
from nvsf_core.stages.views.instances import FOUND
from nvsf_core.stores.checksums import damaged_file
from pipelines.cli import main
from tests.stages.exports.test_card import _manifest

ENTRY = SceneEntry(
    name="long", root=Path("/d"), sequence="s", first_frame=0, last_frame=11, test_frames=(3,), cut_frames=8,
    overlap_frames=3,
)  # fmt: skip


def _box(object_id: int, label: str, frame: int | None, x_m: float) -> dict:
    pose = np.eye(4)
    pose[0, 3] = x_m
    values = {"object_id": object_id, "label": label, "dynamic": frame is not None, "number": frame}
    return values | {"box_to_world": pose.ravel().tolist()}


def _made(home: Path, part: SceneEntry, number: int, **other: object) -> Path:
    """A data set of all frames of a part; each file holds the part's number."""
    folder = home / part.name / "dataset/left/manual-00"
    frames = range(part.first_frame, part.last_frame + 1)
    scans, images = [], []
    for frame in frames:
        for place in (f"velodyne_points/data/{frame:010d}.bin", f"velodyne_points/ring/{frame:010d}.bin",
                      f"image_00/data_rect/{frame:010d}.png"):  # fmt: skip
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            np.full(4, number, np.uint8).tofile(folder / place)
        time_s = 0.1 * (frame - part.first_frame)
        row = {"number": frame, "nearest_frame": frame, "time_s": time_s, "stamp_s": time_s}
        files = {
            "bin": f"velodyne_points/data/{frame:010d}.bin",
            "ring": f"velodyne_points/ring/{frame:010d}.bin",
        }
        scans.append(row | {"files": files, "returns": 1})
        instance = f"image_00/instance/{frame:010d}.png"
        write_grey(folder / instance, np.array([[0, 1]], np.uint16), np.uint16)
        shown = {"file": f"image_00/data_rect/{frame:010d}.png", "instance": instance}
        images.append(row | {"camera": "image_00", **shown})
    boxes = [_box(7, "building", None, 0.0), *(_box(8, "car", frame, float(frame)) for frame in frames)]
    # Two were found to move without a label: one in both parts, and one in each part's own frames.
    shared, own = (9, 10) if number == 0 else (10, 9)
    boxes += [_box(shared, FOUND, frame, 100.0 + frame + 0.2 * number) for frame in frames]
    boxes += [_box(own, FOUND, frame, 200.0 + 50.0 * number) for frame in frames]
    (folder / "kitti360").mkdir()
    costs = {"train_seconds": 10.0 + number, "parameters": 5.0, "model_mb": 1.0, "render_seconds": 0.2}
    metrics = [{**row, "n_defined": number + 1, **costs} for row in _manifest()["field_metrics"][:1]]
    metrics[0]["value"] = float(number)
    # The parts' frames of the scene differ, and with them the last digits.
    cameras = {"image_00": {"kind": "pinhole", "fx": 50.0, "camera_in_lidar": [0.5 + 1e-12 * number, 1.0]}}
    values = {
        "scans": scans,
        "images": images,
        "boxes": boxes,
        "cameras": cameras,
        "instances": [{"value": 1, "object_id": 26_005 - number, "label": "car", "dynamic": True}],
        "field_metrics": metrics,
        **other,
    }
    finish_data_set(folder, _manifest(**values))
    return folder


def test_each_frame_is_of_the_part_in_whose_middle_it_lies(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    assert [(own[0], own[-1]) for _, own in parts] == [(0, 5), (6, 11)]
    for number, (part, _) in enumerate(parts):
        _made(tmp_path, part, number)
    folders = [newest_data_set(tmp_path, part.name, "left", "quick", 0) for part, _ in parts]
    out = join_data_sets("long", parts, folders, tmp_path / "joined")
    manifest = json.loads((out / "manifest.json").read_text())
    assert [row["number"] for row in manifest["scans"]] == list(range(12))
    for place in ("velodyne_points/data", "velodyne_points/ring", "image_00/data_rect"):
        files = sorted((out / place).iterdir())
        assert [int(np.fromfile(file, np.uint8)[0]) for file in files] == [0] * 6 + [1] * 6
    for kind in ("scans", "images"):
        times_s = [[row["time_s"], row["stamp_s"]] for row in manifest[kind]]
        np.testing.assert_allclose(times_s, 0.1 * np.arange(12)[:, None] * [1.0, 1.0])
    assert [row["number"] for row in manifest["boxes"]].count(None) == 1 and len(manifest["boxes"]) == 37
    assert damaged_file(out, manifest["checksums"]) is None
    # Each part's first object is another one: in the joined data set each has a value of its own.
    assert [(row["value"], row["object_id"]) for row in manifest["instances"]] == [(1, 26_004), (2, 26_005)]
    values = [read_numbers(out / row["instance"]).tolist() for row in manifest["images"]]
    assert values == [[[0, 2]]] * 6 + [[[0, 1]]] * 6
    assert manifest["not_joined"] == ["kitti360"] and (out / "card.md").is_file()
    # 0 in one frame and 1 in two: frames count alike, not parts. A drive's model is all parts'.
    (error,) = manifest["field_metrics"]
    assert error["value"] == pytest.approx(2 / 3) and error["n_defined"] == 3
    assert [error[name] for name in ("train_seconds", "model_mb", "render_seconds")] == [21.0, 2.0, 0.2]


def test_an_infinite_error_of_a_part_is_one_of_the_whole_and_an_undefined_one_is_left_out(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    first = {**_manifest()["field_metrics"][0], "render_seconds": 0.1, "value": 0.5}
    infinite, undefined = {**first, "value": "inf"}, {**first, "value": None, "n_defined": 0}
    others = [[infinite, {**first, "metric": "f_score"}], [first, {**undefined, "metric": "f_score"}]]
    folders = [_made(tmp_path, part, k, field_metrics=others[k]) for k, (part, _) in enumerate(parts)]
    out = join_data_sets("long", parts, folders, tmp_path / "joined")
    found = json.loads((out / "manifest.json").read_text())["field_metrics"]
    assert {row["metric"]: row["value"] for row in found} == {"chamfer_m2": "inf", "f_score": 0.5}


def test_a_joined_data_set_names_all_parts_files_and_frames_and_nothing_of_one_part_as_of_all(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    folders = []
    for k, (part, _) in enumerate(parts):
        own = {
            "source_checksums": {"scan 5": "shared", f"scan {9 * k}": f"of {k}"},
            "rendered_from": {"field": f"model {k}"}, "view": {**_manifest()["view"], "frames": [9 * k, 5]},
            "rendering": {"sweep_period_s": 0.1, "scene_to_world": [float(k)]},
        }  # fmt: skip
        folders.append(_made(tmp_path, part, k, **own))
    out = join_data_sets("long", parts, folders, tmp_path / "joined")
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["source_checksums"] == {"scan 5": "shared", "scan 0": "of 0", "scan 9": "of 1"}
    assert manifest["view"]["frames"] == [0, 5, 9] and manifest["rendering"] == {"sweep_period_s": 0.1}
    assert "rendered_from" not in manifest
    assert [one["rendered_from"]["field"] for one in manifest["parts"]] == ["model 0", "model 1"]
    assert json.loads((out / "card.json").read_text())["source"]["files"] == 3
    assert "3 recorded files" in (out / "card.md").read_text()


def test_the_card_of_joined_data_names_no_format_that_is_not_joined(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    view = {**_manifest()["view"], "exports": ["bin", "kitti360"]}
    folders = [_made(tmp_path, part, k, view=view) for k, (part, _) in enumerate(parts)]
    out = join_data_sets("long", parts, folders, tmp_path / "joined")
    assert not (out / "kitti360").exists()
    assert json.loads((out / "card.json").read_text())["what"]["formats"] == ["bin"]
    assert "formats: bin." in (out / "card.md").read_text()
    assert "formats: bin, kitti360." in (folders[0] / "card.md").read_text()


def test_the_command_joins_a_view_that_one_part_does_not_ask_for(tmp_path, monkeypatch):
    catalogue = tmp_path / "scenes.toml"
    catalogue.write_text(
        '[[scene]]\nname = "long"\nroot = "d"\nsequence = "s"\nfirst_frame = 0\nlast_frame = 17\n'
        "test_frames = [3]\ncut_frames = 8\noverlap_frames = 3\n"
        '[[view]]\nname = "left"\nframes = [1, 2, 16]\n'
    )
    monkeypatch.setenv("NVSF_SCENES", str(catalogue))
    monkeypatch.setenv("NVSF_HOME", str(tmp_path / "home"))
    for number, part in enumerate(load_catalogue([catalogue], None)):
        if number != 1:
            _made(tmp_path / "home", part, number)
    said = CliRunner().invoke(main, ["join", "long", "left", "--out", str(tmp_path / "joined")])
    assert said.exit_code == 0, said.output
    assert json.loads((tmp_path / "joined/manifest.json").read_text())["parts_without_view"] == ["long_001"]


def test_what_two_parts_found_is_one_object_where_it_is_at_one_place(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    folders = [_made(tmp_path, part, number) for number, (part, _) in enumerate(parts)]
    out = join_data_sets("long", parts, folders, tmp_path / "joined")
    boxes = json.loads((out / "manifest.json").read_text())["boxes"]
    ways: dict[int, list[tuple[int, float]]] = {}
    for box in boxes:
        if box["label"] == FOUND:
            ways.setdefault(box["object_id"], []).append((box["number"], box["box_to_world"][3]))
    assert min(ways) > 8, "after all labelled ones"
    through = [(frame, 100.0 + frame + 0.2 * (frame > 5)) for frame in range(12)]
    assert sorted(map(sorted, ways.values())) == [
        through, [(frame, 200.0) for frame in range(6)], [(frame, 250.0) for frame in range(6, 12)],
    ]  # fmt: skip


def test_parts_without_a_shared_frame_follow_each_other_in_time():
    def part(first: int) -> dict:
        rows = [{"number": first + k, "time_s": 0.1 * k} for k in range(4)]
        return {"scans": rows, "images": []}

    firsts = [0, 4, 9]
    joined = on_one_clock([part(first) for first in firsts], firsts)
    times_s = [row["time_s"] for one in joined for row in one["scans"]]
    np.testing.assert_allclose(times_s, 0.1 * np.array([0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12]))


def test_parts_of_one_frame_each_are_placed_by_their_own_clocks():
    def part(number: int, time_s: float) -> dict:
        return {"scans": [{"number": number, "time_s": time_s}], "images": []}

    joined = on_one_clock([part(3, 0.3), part(60, 0.0), part(95, 0.2)], [0, 60, 93])
    np.testing.assert_allclose([one["scans"][0]["time_s"] for one in joined], [0.3, 6.0, 9.5])
    with pytest.raises(DataError, match="the first frames 0 and 60 of two alone"):
        on_one_clock([part(0, 0.0), part(60, 0.0)], [0, 60])


def test_parts_that_do_not_ask_for_the_view_are_left_out_and_named(tmp_path):
    view = ViewEntry(name="left", frames=(1, 2, 16))
    parts = parts_of("long", cut_scene(replace(ENTRY, last_frame=17, views=(view,))))
    assert [asks_for(part, "left") for part, _ in parts] == [True, False, True]
    assert [asks_for(part, "test") for part, _ in parts] == [True, False, False]
    folders = [_made(tmp_path, part, k) if k != 1 else None for k, (part, _) in enumerate(parts)]
    out = join_data_sets("long", parts, folders, tmp_path / "joined")
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["parts_without_view"] == ["long_001"]
    assert [one["scene"] for one in manifest["parts"]] == ["long_000", "long_002"]
    numbers = [row["number"] for row in manifest["scans"]]
    assert numbers == [*parts[0][1], *parts[2][1]]
    np.testing.assert_allclose([row["time_s"] for row in manifest["scans"]], 0.1 * np.array(numbers))


def test_parts_of_two_seeds_are_not_joined_and_nothing_is_left_behind(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    folders = [_made(tmp_path, part, number, seed=number) for number, (part, _) in enumerate(parts)]
    with pytest.raises(DataError, match="long_001: expected the seed of long_000"):
        join_data_sets("long", parts, folders, tmp_path / "joined")
    with pytest.raises(DataError, match=r"expected a data set of view 'left'.*seed 3"):
        newest_data_set(tmp_path, "long_000", "left", None, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long_000", "long_001"]


def test_parts_whose_views_ask_for_other_things_are_not_joined(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    asked = _manifest()["view"]
    others = [{**asked, "frames": [1]}, {**asked, "shift_m": [0.0, 3.0, 0.0], "frames": [9]}]
    folders = [_made(tmp_path, part, k, view=others[k]) for k, (part, _) in enumerate(parts)]
    with pytest.raises(DataError, match="long_001: expected the view of long_000"):
        join_data_sets("long", parts, folders, tmp_path / "joined")


def test_the_newest_is_the_last_of_the_order_that_was_noted_whatever_the_files_times_say(tmp_path):
    ((part, _), *_) = parts_of("long", cut_scene(ENTRY))
    newer = _made(tmp_path, part, 0)
    older = newer.parent / "manual-01"
    shutil.copytree(newer, older)
    os.utime(older / "manifest.json", (2e9, 2e9))
    assert newest_data_set(tmp_path, part.name, "left", None, 0) == older
    order = tmp_path / part.name / "dataset/.order/left.json"
    order.parent.mkdir()
    order.write_text(json.dumps({"versions": ["manual-01", "manual-00"]}))
    assert newest_data_set(tmp_path, part.name, "left", None, 0) == newer


def test_a_version_that_is_being_deleted_is_not_the_newest(tmp_path):
    ((part, _), *_) = parts_of("long", cut_scene(ENTRY))
    folder = _made(tmp_path, part, 0)
    hidden = folder.parent / ".removing-manual-01-0123abcd"
    shutil.copytree(folder, hidden)
    (hidden / "manifest.json").touch()
    assert newest_data_set(tmp_path, part.name, "left", None, 0) == folder


def test_a_view_of_times_is_not_joined(tmp_path):
    parts = parts_of("long", cut_scene(replace(ENTRY, last_frame=7)))
    row = {"number": 0, "nearest_frame": 3, "files": {}, "returns": 1, "time_s": 0.0}
    folder = _made(tmp_path, parts[0][0], 0, scans=[row])
    with pytest.raises(DataError, match="expected a view of recorded frames"):
        join_data_sets("long", parts, [folder], tmp_path / "joined")
