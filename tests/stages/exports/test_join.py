"""Data sets of a cut drive's parts become one: each frame once, of the part whose it is."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.cuts import cut_scene, parts_of
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.writer import read_numbers, write_numbers
from nvsf_core.errors import DataError
from nvsf_core.stages.exports.join import join_data_sets, newest_data_set
from nvsf_core.stages.exports.write import finish_data_set
from nvsf_core.stores.checksums import damaged_file
from tests.stages.exports.test_card import _manifest

ENTRY = SceneEntry(
    name="long", root=Path("/d"), sequence="s", first_frame=0, last_frame=11, test_frames=(3,), cut_frames=8,
    overlap_frames=3,
)  # fmt: skip


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
        row = {"number": frame, "nearest_frame": frame, "time_s": 0.1 * frame}
        files = {
            "bin": f"velodyne_points/data/{frame:010d}.bin",
            "ring": f"velodyne_points/ring/{frame:010d}.bin",
        }
        scans.append(row | {"files": files, "returns": 1})
        instance = f"image_00/instance/{frame:010d}.png"
        write_numbers(folder / instance, np.array([[0, 1]], np.uint16))
        shown = {"file": f"image_00/data_rect/{frame:010d}.png", "instance": instance}
        images.append(row | {"camera": "image_00", **shown})
    boxes = [{"object_id": 7, "number": None}, *({"object_id": 8, "number": frame} for frame in frames)]
    (folder / "kitti360").mkdir()
    metrics = [{**row, "n_defined": number + 1} for row in _manifest()["field_metrics"][:1]]
    metrics[0]["value"] = float(number)
    values = {
        "scans": scans,
        "images": images,
        "boxes": boxes,
        "cameras": {},
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
    assert [row["number"] for row in manifest["boxes"]].count(None) == 1 and len(manifest["boxes"]) == 13
    assert damaged_file(out, manifest["checksums"]) is None
    # Each part's first object is another one: in the joined data set each has a value of its own.
    assert [(row["value"], row["object_id"]) for row in manifest["instances"]] == [(1, 26_004), (2, 26_005)]
    values = [read_numbers(out / row["instance"]).tolist() for row in manifest["images"]]
    assert values == [[[0, 2]]] * 6 + [[[0, 1]]] * 6
    assert manifest["not_joined"] == ["kitti360"] and (out / "card.md").is_file()
    # 0 in one frame and 1 in two: frames count alike, not parts.
    assert manifest["field_metrics"][0]["value"] == pytest.approx(2 / 3)


def test_parts_of_two_seeds_are_not_joined_and_nothing_is_left_behind(tmp_path):
    parts = parts_of("long", cut_scene(ENTRY))
    folders = [_made(tmp_path, part, number, seed=number) for number, (part, _) in enumerate(parts)]
    with pytest.raises(DataError, match="long_001: expected the seed of long_000"):
        join_data_sets("long", parts, folders, tmp_path / "joined")
    with pytest.raises(DataError, match=r"expected a data set of view 'left'.*seed 3"):
        newest_data_set(tmp_path, "long_000", "left", None, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long_000", "long_001"]


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
