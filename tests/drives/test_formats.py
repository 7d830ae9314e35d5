"""One drive in every format: each reader gives the same scans, images, poses, mounting and times."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DemoSize, write_demo
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.detect import kind_of, whole_drive
from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.validation import read_drive
from nvsf_core.errors import CalibrationError, DataError
from nvsf_core.stages.exports.kitti import write_kitti
from nvsf_core.stages.exports.kitti360 import write_kitti360
from nvsf_core.stages.exports.records import DataSet
from nvsf_core.stages.exports.ros import write_mcap
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.imports.odometry import times_in_sweeps
from nvsf_core.stages.runner.facts import scene_facts
from tests.drives.copies import FRAMES, PERIOD_S, assert_same_drive, data_set, scene_at, tiny_scene
from tests.drives.kitti.raw_writer import write_raw


def _silent(line: str) -> None:
    pass


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("formats")
    write_demo(folder / "demo", size=DemoSize.tiny())
    return folder


@pytest.fixture(scope="module")
def recorded(root):
    return drive_of(tiny_scene(root / "demo"))


@pytest.fixture(scope="module")
def plain(root):
    done = import_drive(tiny_scene(root / "demo"), root / "plain", progress=_silent)
    assert (done.scans, done.images, done.frames, done.left_out) == (4, 4, 4, ())
    return root / "plain"


def test_a_plain_drive_is_the_recorded_one(plain, recorded):
    assert kind_of(plain) == "plain"
    found = drive_of(scene_at(plain, "plain"))
    assert_same_drive(found, recorded, "image_00", 1e-6)
    assert found.facts().sensor == "HDL-64E"
    boxes = [{(one.object_id, one.frame): one for one in drive.boxes().boxes} for drive in (found, recorded)]
    assert boxes[0].keys() == boxes[1].keys()
    for key, one in boxes[0].items():
        assert np.allclose(one.box_to_world, boxes[1][key].box_to_world, atol=1e-5)


def test_an_imported_drive_of_kitti360s_layout_is_the_recorded_one(root, recorded, plain):
    import_drive(scene_at(plain, "plain"), root / "back", layout="kitti360", progress=_silent)
    assert kind_of(root / "back") == "kitti360"
    scene = whole_drive(root / "back", "kitti360")
    assert (scene.first_frame, scene.last_frame) == (0, 3)
    found = drive_of(scene)
    assert_same_drive(found, recorded, "image_00", 1e-5)
    assert found.facts().disagreement.translation_m < 1e-5


@pytest.mark.parametrize("layout", ["plain", "kitti360"])
def test_a_part_of_a_drive_is_imported_under_its_own_numbers(root, recorded, tmp_path, layout):
    part = replace(tiny_scene(root / "demo"), first_frame=1, last_frame=2)
    done = import_drive(part, tmp_path / "part", layout=layout, progress=_silent)
    assert (done.scans, done.images, done.frames) == (2, 2, 2)
    scene = whole_drive(tmp_path / "part", layout)
    assert (scene.first_frame, scene.last_frame) == (1, 2)
    found = drive_of(scene)
    assert sorted(found.facts().poses) == [1, 2]
    assert np.array_equal(found.read_scan(2).points, recorded.read_scan(2).points)
    with pytest.raises(
        DataError, match=r"expected frames within 0 to 3, .* found first 1 and last 9; correct"
    ):
        whole_drive(root / "demo", "kitti360", first=1, last=9)
    with pytest.raises(DataError, match="before the last, found first 50; correct --first or --last"):
        whole_drive(root / "demo", "kitti360", first=50)


def test_kittis_odometry_tree_is_read_back(root, recorded):
    write_kitti(root, data_set(tiny_scene(root / "demo")))
    assert kind_of(root / "kitti") == "kitti_odometry"
    assert_same_drive(drive_of(scene_at(root / "kitti", "kitti_odometry", "00")), recorded, "image_02", 1e-5)


def test_scans_of_kittis_odometry_are_not_compensated_again(root, tmp_path):
    write_kitti(root / "corrected", data_set(tiny_scene(root / "demo")))
    scene = scene_at(root / "corrected/kitti", "kitti_odometry", "00")
    assert not scene.is_to_compensate and scene_at(root, "kitti_raw").is_to_compensate
    source = drive_of(scene)
    assert not times_in_sweeps(source, source.decode_scan(0)).any()
    again = drive_of(replace(scene, compensate=True))
    assert np.ptp(times_in_sweeps(again, again.decode_scan(0))) > 0.9
    assert scene_facts(scene) == scene_facts(replace(scene, compensate=False))
    assert scene_facts(scene) != scene_facts(again.scene), "what was made of them before is made again"
    import_drive(scene, tmp_path / "out", progress=_silent)
    (kept,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    assert not kept.is_to_compensate


@pytest.mark.parametrize("layout", ["plain", "kitti360"])
def test_our_own_sequence_of_kitti_is_imported_as_one_to_compensate(root, tmp_path, layout):
    write_kitti(tmp_path, data_set(tiny_scene(root / "demo")))
    import_drive(whole_drive(tmp_path / "kitti", "kitti_odometry"), tmp_path / "out", layout=layout,
                 progress=_silent)  # fmt: skip
    (kept,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    assert kept.is_to_compensate
    shutil.rmtree(tmp_path / "kitti/sequences/00/velodyne_time")
    assert not whole_drive(tmp_path / "kitti", "kitti_odometry").is_to_compensate, "the benchmark's own"
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "kitti/sequences/00/velodyne_time").mkdir()
    (tmp_path / "kitti/sequences/00/velodyne_time/000000.bin").symlink_to(tmp_path / "pipe")
    with pytest.raises(DataError, match="no times of points, expected a regular file"):
        whole_drive(tmp_path / "kitti", "kitti_odometry")


@pytest.mark.parametrize(("write", "kind"), [(write_kitti, "kitti_odometry"), (write_kitti360, "kitti360")])
def test_our_own_tree_of_a_scene_of_instants_is_imported_as_one(root, tmp_path, write, kind):
    moving = data_set(tiny_scene(root / "demo"))
    assert moving.scan is not None
    # Times before the instant, of a sweep that lasts 0 s, are -0: trees that were written so are out there.
    at_once = replace(moving.scan(0), offset_s=0.0 * moving.scan(0).offset_s)
    assert np.signbit(at_once.offset_s).any() and not at_once.offset_s.any()
    write(tmp_path, replace(moving, sweep_period_s=0.0, scan=lambda index: at_once))
    name = kind.removesuffix("_odometry")
    instants = whole_drive(tmp_path / name, kind)
    assert not instants.is_to_compensate
    assert drive_of(instants).read_scan(0).offset_s is None, "they are the times of no sensor that turns"
    again = import_drive(
        whole_drive(tmp_path / name, kind), tmp_path / "again", layout="kitti360", progress=_silent
    )
    assert again.scans and not whole_drive(tmp_path / "again", "kitti360").is_to_compensate
    write(tmp_path / "moving", moving)
    assert whole_drive(tmp_path / "moving" / name, kind).is_to_compensate


def _timed(root: Path, *, spin: float, sweep_s: float, step_s: float) -> DataSet:
    """The demo as a sensor has it that turns so (1 = clockwise), and whose scans are so far apart."""
    usual = data_set(tiny_scene(root / "demo"))
    assert usual.scan is not None
    scans = [usual.scan(index) for index in range(FRAMES)]
    scale = np.float32(spin * sweep_s / PERIOD_S)
    timed = [replace(one, offset_s=scale * one.offset_s) for one in scans]
    return replace(usual, stamp_s=step_s * np.arange(FRAMES), sweep_period_s=sweep_s, scan=timed.__getitem__)


@pytest.mark.parametrize(("write", "kind"), [(write_kitti, "kitti_odometry"), (write_kitti360, "kitti360")])
@pytest.mark.parametrize(
    "timed",
    [
        {"spin": 1.0, "sweep_s": 0.05, "step_s": 0.1},
        {"spin": 1.0, "sweep_s": 0.1, "step_s": 0.04},
        {"spin": -1.0, "sweep_s": 0.1, "step_s": 0.1},
    ],
    ids=["pauses between sweeps", "sweeps overlap", "counter-clockwise"],
)
def test_our_own_trees_are_read_with_rings_and_times_of_any_sensor(root, tmp_path, write, kind, timed):
    data = _timed(root, **timed)
    write(tmp_path, data)
    scene = whole_drive(tmp_path / kind.removesuffix("_odometry"), kind)
    done = import_drive(scene, tmp_path / "again", progress=_silent)
    assert done.left_out == () and not any("not read" in note for note in done.notes)
    (kept,) = load_catalogue([tmp_path / "again/scenes.toml"], None)
    for drive in (drive_of(scene), drive_of(kept)):
        assert drive.facts().times.sweep_period_s == pytest.approx(timed["sweep_s"], rel=1e-3)
        for frame in range(FRAMES):
            scan, recorded = drive.read_scan(frame), data.scan(frame)
            assert np.array_equal(scan.ring, recorded.ring)
            assert np.abs(scan.offset_s - recorded.offset_s).max() < 1e-5
        names = [path.parent.name for path in drive.section().files if path.suffix == ".bin"]
        assert len(names) == 3 * FRAMES, "a change of rings or times is one of the drive"


@pytest.mark.parametrize(
    ("write", "kind", "time"),
    [(write_kitti, "kitti_odometry", "velodyne_time"), (write_kitti360, "kitti360", "time")],
)
def test_times_that_are_not_of_their_scans_are_refused(root, tmp_path, write, kind, time):
    write(tmp_path, data_set(tiny_scene(root / "demo")))
    scene = whole_drive(tmp_path / kind.removesuffix("_odometry"), kind)
    paths = sorted(next(tmp_path.rglob(time)).iterdir())
    paths[0].write_bytes(paths[0].read_bytes()[:-3])
    np.full(len(paths[1].read_bytes()) // 4, np.nan, "<f4").tofile(paths[1])
    paths[3].unlink()
    drive = drive_of(scene)
    with pytest.raises(DataError, match=r"0\.bin: expected \d+ values <f4, one time a point, found \d+"):
        drive.read_scan(0)
    with pytest.raises(DataError, match=r"1\.bin: time: expected a finite time of each point"):
        drive.read_scan(1)
    assert drive.read_scan(3).offset_s is None
    for path in paths[:3]:
        path.rename(path.with_name(f"scan_{path.name}"))
    with pytest.raises(DataError, match=r"time: expected files named by the numbers of scans, .* 'scan_0"):
        drive_of(scene).facts()


@pytest.mark.parametrize("write", [write_kitti, write_kitti360])
def test_trees_without_rings_and_times_have_none(root, tmp_path, write):
    write(tmp_path, data_set(tiny_scene(root / "demo")))
    for folder in [one for name in ("ring", "time") for one in tmp_path.rglob(f"*{name}") if one.is_dir()]:
        shutil.rmtree(folder)
    (place,) = tmp_path.iterdir()
    scan = drive_of(whole_drive(place, kind_of(place))).read_scan(1)
    assert scan.ring is None and scan.offset_s is None


def test_a_sequence_of_kittis_odometry_without_poses_says_how_to_find_them(root):
    write_kitti(root / "bare", data_set(tiny_scene(root / "demo")))
    shutil.rmtree(root / "bare/kitti/poses")
    with pytest.raises(DataError, match=r"expected poses in .*nvsf import"):
        drive_of(scene_at(root / "bare/kitti", "kitti_odometry", "00")).facts()


def test_a_raw_drive_of_kitti_is_read_with_its_tracklets(root, recorded):
    sequence = write_raw(root / "raw", data_set(tiny_scene(root / "demo")))
    assert kind_of(root / "raw") == "kitti_raw"
    found = drive_of(scene_at(root / "raw", "kitti_raw", sequence))
    # Degrees of latitude with 12 digits are a tenth of a millimetre, and Mercator stretches a street by less.
    assert_same_drive(found, recorded, "image_02", 2e-3)
    boxes = {one.frame: one for one in found.boxes().boxes if one.label == "car" and one.dynamic}
    assert sorted(boxes) == [0, 1, 2, 3]
    sides_m = np.linalg.norm(boxes[0].box_to_world[:3, :3], axis=0)
    assert np.allclose(sides_m, [4.3, 1.8, 1.5], atol=1e-6)
    in_lidar = np.linalg.inv(found.facts().poses[2] @ found.facts().calibration.lidar_to_pose)
    assert np.allclose((in_lidar @ boxes[2].box_to_world)[:3, 3], [12.0 + 2.0 * 2, 3.0, -0.9], atol=1e-6)


def test_a_tracklet_with_an_entity_is_refused(root):
    sequence = write_raw(root / "evil", data_set(tiny_scene(root / "demo")))
    path = root / "evil" / sequence / "tracklet_labels.xml"
    path.write_text('<!DOCTYPE a [<!ENTITY b "c">]>' + path.read_text())
    with pytest.raises(DataError, match="cannot read tracklets"):
        drive_of(scene_at(root / "evil", "kitti_raw", sequence)).boxes()


@pytest.fixture(scope="module")
def bag(root):
    pytest.importorskip("rosbags", reason="the extra `rosbags` is not installed")
    write_mcap(root, data_set(tiny_scene(root / "demo")))
    return root / "mcap"


def test_a_bag_of_our_own_is_read_back_as_a_folder_and_as_a_file(bag, recorded):
    (file,) = bag.glob("*.mcap")
    for place in (bag, file):
        assert kind_of(place) == "bag"
        found = drive_of(scene_at(place, "bag"))
        assert_same_drive(found, recorded, "image_00", 1e-6)
        scan = found.read_scan(1)
        assert len(np.unique(scan.ring)) == 8 and np.abs(scan.offset_s).max() <= 0.05 + 1e-6
        assert whole_drive(place, "bag").last_frame == 3


def test_a_bag_is_imported_with_its_rings_and_times(bag, root, recorded):
    done = import_drive(whole_drive(bag, "bag"), root / "of_bag", progress=_silent)
    assert (done.scans, done.images, done.left_out) == (4, 4, ())
    found = drive_of(scene_at(root / "of_bag", "plain"))
    assert_same_drive(found, recorded, "image_00", 1e-6)
    scan, kept = found.read_scan(2), drive_of(scene_at(bag, "bag")).read_scan(2)
    assert np.array_equal(scan.ring, kept.ring) and np.allclose(scan.offset_s, kept.offset_s, atol=1e-6)
    assert json.loads((root / "of_bag/drive.json").read_text())["lidar"] == "found"


def test_a_cut_bag_is_refused_with_what_mends_it(bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    (tmp_path / "cut.mcap").write_bytes(file.read_bytes()[:20_000])
    drive = drive_of(scene_at(tmp_path / "cut.mcap", "bag"))
    assert drive.has_data(), "one damaged bag does not keep a catalogue's other scenes from being trained"
    with pytest.raises(DataError, match=r"cannot be read as a bag|ends after"):
        drive.facts()


def test_bad_frames_of_a_plain_drive_are_named_one_by_one_and_left_out(plain, tmp_path):
    shutil.copytree(plain, tmp_path / "bad")
    scans, images = tmp_path / "bad/scans", tmp_path / "bad/images/image_00"
    (scans / "0000000000.bin").write_bytes(b"abc")
    (scans / "0000000001.bin").unlink()
    (images / "0000000003.png").write_bytes(b"\x89PNG")
    lines = (tmp_path / "bad/poses.csv").read_text().splitlines()
    (tmp_path / "bad/poses.csv").write_text("\n".join([*lines[:3], *lines[4:]]) + "\n")
    found = read_drive(scene_at(tmp_path / "bad", "plain", cameras=("image_00",)), _silent)
    assert [row.scan_valid for row in found.frames] == [False, False, True, True]
    assert "rows of 16 bytes" in found.frames[0].reason
    assert "no scan file scans/0000000001" in found.frames[1].reason
    # Poses are a path: the missing one lies between its neighbours.
    assert found.frames[2].pose_valid
    done = import_drive(scene_at(tmp_path / "bad", "plain"), tmp_path / "out", progress=_silent)
    assert (done.scans, done.images) == (2, 3)
    assert [words.split(":")[0] for words in done.left_out] == ["scan 0", "scan 1", "image image_00 3"]
    assert json.loads((tmp_path / "out/import.json").read_text())["left_out"] == list(done.left_out)


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("poses.csv", "frame,time_s,x\n0,0,1\n", r"poses\.csv: expected the columns time_s, x, y, z, qx"),
        ("frames.csv", "frame,time_s\n0,zero\n", r"frames\.csv, line 2, time_s: expected a finite number"),
        ("frames.csv", "frame,time_s\n0,0\n1,0\n", r"frames\.csv: expected ascending times"),
        ("frames.csv", "frame,time_s\n0,0\n0,1\n", r"expected each frame once, found 0"),
        ("drive.json", '{"lidar": "HDL-65"}', r"drive\.json: lidar: expected 'found' or one of HDL-64E"),
        ("drive.json", '{"lidar": ["found"]}', r"drive\.json: lidar: expected 'found' or one of HDL-64E"),
        ("drive.json", f'{{"lidar_to_pose": [{"9" * 400}]}}', r"drive\.json: lidar_to_pose: .* 4 x 4 matrix"),
        ("drive.json", '{"times_assumed": "no\\ud800"}', r"times_assumed: expected why, in a line"),
        ("cameras.json", '{"image_00": {"model": "box"}}', r"image_00: model: expected one of pinhole"),
        ("cameras.json", "{", r"cameras\.json: expected JSON"),
        ("cameras.json", '{"image_00": {}, "image_00": {}}', r"each key once, found 'image_00' again"),
        ("cameras.json", '{"image_00": {"colour": "bgr"}}', r"image_00: expected the keys of .* 'colour'"),
    ],
)
def test_a_mistake_in_a_table_is_named_with_file_and_place(plain, tmp_path, name, text, reason):
    shutil.copytree(plain, tmp_path / "bad")
    (tmp_path / "bad" / name).write_text(text)
    with pytest.raises((DataError, CalibrationError), match=reason):
        drive_of(scene_at(tmp_path / "bad", "plain")).facts()


def test_an_import_never_overwrites_and_leaves_nothing_half_written(plain, tmp_path):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/mine").touch()
    with pytest.raises(DataError, match="taken"):
        import_drive(scene_at(plain, "plain"), tmp_path / "taken", progress=_silent)
    shutil.copytree(plain, tmp_path / "none")
    for inside in ("within", "scans/within", "."):
        place = tmp_path / "none" / inside
        with pytest.raises(DataError, match=r"outside of the drive, found it in|taken"):
            import_drive(scene_at(tmp_path / "none", "plain"), place, progress=_silent)
        assert inside == "." or not place.exists()
    for path in (*tmp_path.glob("none/scans/*"), *tmp_path.glob("none/images/*/*")):
        path.write_bytes(b"")
    with pytest.raises(DataError, match=r"expected a scan or an image that can be used.*scan 0"):
        import_drive(scene_at(tmp_path / "none", "plain"), tmp_path / "out", progress=_silent)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["none", "taken"]


def test_what_is_no_recording_is_refused_with_what_each_looks_like(tmp_path: Path):
    with pytest.raises(DataError, match=r"found another folder or file: a bag .* docs/drives\.md"):
        kind_of(tmp_path)


@pytest.mark.parametrize(
    ("folder", "name"), [("drives", "drives_drive"), ("dagster", "dagster_drive"), ("-8", "8")]
)
def test_a_drive_may_lie_in_a_folder_of_any_name(plain, tmp_path, folder, name):
    shutil.copytree(plain, tmp_path / folder)
    scene = whole_drive(tmp_path / folder, "plain")
    assert scene.name == name
    import_drive(scene, tmp_path / "out", progress=_silent)
    (again,) = load_catalogue([tmp_path / "out/scenes.toml"], None)
    assert again.name == name


def test_a_data_set_of_high_frame_numbers_has_few_timestamps_that_are_read_again(root, tmp_path):
    data = data_set(tiny_scene(root / "demo"))
    write_kitti360(tmp_path, replace(data, numbers=[3_000_000 + number for number in data.numbers]))
    paths = list(tmp_path.rglob("timestamps*.txt"))
    assert len(paths) >= 3 and sum(path.stat().st_size for path in paths) < 10_000
    times = drive_of(whole_drive(tmp_path / "kitti360", "kitti360")).times()
    assert not times.is_assumed and np.allclose(times.time_s, data.stamp_s - data.stamp_s[0], atol=2e-6)
