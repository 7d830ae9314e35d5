import os
from dataclasses import fields
from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import UNSET_ROOT, catalogue_from_environment, load_catalogue
from nvsf_core.drives.catalogue_page import as_markdown
from nvsf_core.drives.drive import has_data
from nvsf_core.drives.entries import ViewEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.view_parts import CameraEntry, SensorEntry, Waypoint
from nvsf_core.errors import DataError

REPOSITORY = Path(__file__).resolve().parents[2]
SCENE = """
[[scene]]
name = "a"
root = "drives/a"
sequence = "s_sync"
first_frame = 3
last_frame = 6
test_frames = [4]
"""
VIEW = SCENE + '[[view]]\nname = "v"\n'
STATIC = {1538, 1728, 1908, 3353}
DYNAMIC = {2350, 4950, 8120, 10200, 10750, 11400}


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_the_papers_ten_scenes_have_its_frames_and_splits() -> None:
    entries = {entry.name: entry for entry in catalogue_from_environment({})}
    for number in STATIC | DYNAMIC:
        entry = entries[f"kitti360_{number}"]
        step, count = (13, 64) if number in STATIC else (10, 51)
        assert entry.sequence == "2013_05_28_drive_0000_sync"
        assert (entry.first_frame, entry.last_frame) == (number, number + count - 1)
        assert entry.test_frames == tuple(range(number + step, number + 4 * step + 1, step))
    assert len(entries) == 11


def test_the_demo_lies_in_the_home_and_asks_for_a_shifted_view() -> None:
    demo = next(e for e in catalogue_from_environment({"NVSF_HOME": "/somewhere"}) if e.name == "demo")
    assert demo.root == Path("/somewhere/drives/demo") and demo.recipe == "short"
    assert [(view.name, view.shift_m) for view in demo.views] == [("shift_1m", (0.0, 1.0, 0.0))]


def test_the_full_street_asks_for_views_off_its_path_of_another_sensor_and_between_frames() -> None:
    street = next(
        entry
        for entry in catalogue_from_environment(
            {"NVSF_HOME": "/somewhere", "NVSF_SCENES": str(REPOSITORY / "benchmarks/scenes.toml")}
        )
        if entry.name == "street"
    )
    assert street.root == Path("/somewhere/drives/street") and street.last_frame == 31
    *off_path, vlp16, os1_128, between, frozen = street.views
    assert [(view.name, view.shift_m, view.yaw_deg) for view in off_path] == [
        ("shift_1m", (0.0, 1.0, 0.0), 0.0),
        ("shift_2m", (0.0, 2.0, 0.0), 0.0),
        ("shift_3m", (0.0, 3.0, 0.0), 0.0),
        ("right_1m", (0.0, -1.0, 0.0), 0.0),
        ("up_1m", (0.0, 0.0, 1.0), 0.0),
        ("yaw_15", (0.0, 0.0, 0.0), 15.0),
    ]
    assert {view.frames for view in off_path} == {(4, 12, 20, 28)}
    assert (vlp16.name, vlp16.sensor, len(vlp16.frames)) == ("vlp16", "VLP-16", 4)
    assert (os1_128.name, os1_128.sensor, len(os1_128.frames)) == ("os1_128", "OS1-128", 4)
    assert between.name == "between" and between.times_s is not None and len(between.times_s) == 4
    assert all(abs(time_s / 0.1 % 1.0 - 0.5) < 1e-9 for time_s in between.times_s)
    assert (frozen.name, frozen.frames, frozen.frozen_at_s) == ("frozen", (4, 12, 16, 20, 28), 1.6)


def test_the_demo_lies_in_the_working_directory_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    demo = next(e for e in catalogue_from_environment({}) if e.name == "demo")
    assert demo.root == tmp_path / ".nvsf" / "drives" / "demo"


def test_the_longest_scenes_come_first() -> None:
    lengths = [e.last_frame - e.first_frame for e in catalogue_from_environment({})]
    assert lengths == sorted(lengths, reverse=True)


def test_roots_are_relative_to_the_file_that_names_them(tmp_path: Path) -> None:
    (entry,) = load_catalogue([written(tmp_path / "here" / "c.toml", SCENE)], None)
    assert entry.root == tmp_path / "here" / "drives" / "a"


def test_a_scene_without_a_root_is_looked_for_under_kitti360(tmp_path: Path) -> None:
    path = written(tmp_path / "c.toml", SCENE.replace('root = "drives/a"', ""))
    assert load_catalogue([path], Path("/kitti360"))[0].root == Path("/kitti360")
    (homeless,) = load_catalogue([path], None)
    assert homeless.root == UNSET_ROOT and not has_data(homeless)


def test_several_files_are_one_catalogue(tmp_path: Path) -> None:
    first = written(tmp_path / "a.toml", SCENE)
    text = SCENE.replace('"a"', '"b"') + '[[view]]\nname = "v"\nscenes = ["a"]\n'
    second = written(tmp_path / "b.toml", text)
    environ = {"NVSF_SCENES": os.pathsep.join([str(first), str(second)])}
    views = {entry.name: [view.name for view in entry.views] for entry in catalogue_from_environment(environ)}
    assert views == {"a": ["v"], "b": []}


def test_a_view_asks_for_frames_or_for_times(tmp_path: Path) -> None:
    keys = {"u": 'frames = "all"', "v": "frames = [3, 4]", "w": "times_s = [0.05]"}
    text = SCENE + "".join(f'[[view]]\nname = "{name}"\n{line}\n' for name, line in keys.items())
    (entry,) = load_catalogue([written(tmp_path / "c.toml", text)], None)
    assert [(v.frames, v.times_s) for v in entry.views] == [("all", None), ((3, 4), None), ((), (0.05,))]


def test_a_views_truth_lies_below_the_scenes_root_or_where_its_path_says(tmp_path: Path) -> None:
    folders = 'image_00 = "right", image_01 = "/data/right", image_02 = "$NVSF_HOME/truth"'
    path = written(tmp_path / "c.toml", VIEW + f"truth = {{ {folders} }}\n")
    (entry,) = load_catalogue([path], None, home=Path("/home/of/all"))
    named = {camera: entry.root / folder for camera, folder in entry.views[0].truth}
    assert named == {
        "image_00": tmp_path / "drives/a/right", "image_01": Path("/data/right"),
        "image_02": Path("/home/of/all/truth"),
    }  # fmt: skip


def test_a_scene_has_data_once_a_scan_or_an_image_of_its_section_is_there(tmp_path: Path) -> None:
    (entry,) = load_catalogue([written(tmp_path / "c.toml", SCENE)], None)
    layout = DriveLayout(entry.root, entry.sequence)
    assert not has_data(entry)
    layout.scan_path(2).parent.mkdir(parents=True)
    layout.scan_path(2).touch()
    assert not has_data(entry)
    layout.camera_dir("image_02").mkdir(parents=True)
    layout.image_path("image_02", 6).touch()
    assert has_data(entry)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (SCENE + SCENE, "scene 'a' is given twice"),
        (SCENE + 'colour = "red"\n', "unknown keys colour"),
        (SCENE + "[other]\n", "unknown keys other"),
        (SCENE.replace('sequence = "s_sync"\n', ""), "missing keys sequence"),
        (SCENE.replace("[4]", "[7]"), r"test_frames between them"),
        (SCENE.replace("[4]", "[3, 4, 5, 6]"), "at least one to train on"),
        (SCENE.replace('"a"', '"a/../b"'), "a name is a folder"),
        (SCENE.replace("= 3", '= "3"'), "first_frame: expected a whole number"),
        (SCENE + 'cameras = ["image_09"]\n', "image_09"),
        (SCENE + "sweep_period_s = -1\n", "sweep_period_s"),
        (SCENE + "compensate = 0\n", "compensate: expected true or false, found 0"),
        (SCENE + '[[view]]\nname = "v"\nscenes = ["b"]\n', "unknown scene 'b'"),
        (SCENE + '[[view]]\nname = "v"\nscenes = ["a"]\nframes = [9]\n', r"frames \[9\] are not in 3..6"),
        (VIEW + "frames = [3, 4.5]\n", "frames: expected .*moments between frames are `times_s`"),
        (VIEW + "frames = [3020.5]\n", r"found \[3020.5\]; moments between frames are `times_s`"),
        (VIEW + "frames = [3]\ntimes_s = [0.1]\n", "expected `frames` or `times_s`, found both"),
        (VIEW + "times_s = [0.2, 0.1]\n", "times_s: expected ascending times"),
        (VIEW + "times_s = 0.1\n", "times_s: expected a tuple of seconds"),
        (VIEW + 'frozen_at_s = "now"\n', "frozen_at_s: expected seconds"),
        (SCENE + '[[view]]\nname = "v"\nshift_m = [1.0]\n', "shift_m"),
        (SCENE + '[[view]]\nname = "test"\n', "splits of recorded frames"),
        (VIEW + 'truth = "right"\n', "truth: expected cameras with their folders"),
        (VIEW + 'truth = { image_09 = "right" }\n', "truth: expected cameras that scene a uses"),
        (VIEW + "truth = { image_00 = 3 }\n", "truth: image_00: expected 1 to 1000 printable characters"),
        (VIEW + 'times_s = [0.05]\ntruth = { image_00 = "right" }\n', "named by frames"),
        (VIEW + 'sensor = "VLP-16"\ntruth = { image_00 = "right" }\n', "leave `sensor` out"),
        (
            SCENE
            + 'cameras = ["image_01"]\n'
            + VIEW.removeprefix(SCENE)
            + 'truth = { image_00 = "right" }\n',
            "truth: expected cameras that scene a uses, found image_00",
        ),
        (SCENE + '[[view]]\nname = "v"\n[[view]]\nname = "v"\n', "views: expected each name once"),
        ("[scene]\nname = 1\n", "double the brackets"),
        ("not toml", "is no TOML"),
    ],
)
def test_a_mistake_in_a_catalogue_is_named_with_its_file(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(DataError, match=rf"c\.toml.*{reason}"):
        load_catalogue([written(tmp_path / "c.toml", text)], None)


ALL_KEYS = """
[[sensor]]
name = "mine"
elevation_deg = [5.0, 0.0, -5.0]
azimuth_step_deg = 0.4
rate_hz = 20.0
divergence_mrad = 3.0

[[view]]
name = "all"
sensor = "mine"
footprint = true
pitch_deg = 2.0
roll_deg = -1.0
pose_file = "poses.txt"
path_in = "world"
rate_hz = 5.0
speed = 0.5
frozen_at_s = 0.1
cameras = ["image_00"]
hits = "threshold"
range_noise_m = "measured"
exports = ["kitti360", "kitti", "bin"]

[[view.camera]]
name = "image_10"
like = "image_00"
width = 64
height = 48
focal_px = 40.0

[[view]]
name = "curve"
waypoints = [
  { time_s = 0.0, position_m = [0.0, 0.0, 0.0] },
  { time_s = 0.3, position_m = [3.0, 1.0, 0.0], yaw_deg = 10.0 },
]
"""


def test_every_part_of_a_view_is_read(tmp_path: Path) -> None:
    written(
        tmp_path / "poses.txt", "# t x y z q\n0.0 1 2 3 0 0 0 1\n0.3, 1, 0, 0, 2, 0, 1, 0, 3, 0, 0, 1, 4\n"
    )
    (entry,) = load_catalogue([written(tmp_path / "c.toml", SCENE + ALL_KEYS)], None)
    view, curve = entry.views
    assert view.sensor_name == "mine" and view.frames == () and view.camera[0].model().fx == 40.0
    assert view.pose_file is not None and view.pose_file.time_s == (0.0, 0.3)
    assert view.pose_file.poses[0] == (1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3)
    assert [point.position_m for point in curve.waypoints] == [(0.0, 0.0, 0.0), (3.0, 1.0, 0.0)]


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ('rate_hz = 5.0\nframes = [3]\n', "expected `frames` or `rate_hz`, found both"),
        ("rate_hz = 0\n", r"rate_hz: expected 0.1 to 1000"),
        ("speed = 0\n", "speed: expected 0.01 to 100"),
        ('sensor = "none"\ncameras = []\n', "expected a LiDAR or a camera"),
        ('sensor = "Pandar64"\nfootprint = true\n', "beam width of Pandar64 is not known"),
        ('cameras = ["image_07"]\n', r"cameras: expected cameras that scene a uses"),
        ('hits = "some"\n', "hits: expected one of sampled, threshold"),
        ("range_noise_m = -1\n", "range_noise_m: expected 0 to 10 m"),
        ('range_noise_m = "much"\n', "range_noise_m: expected metres or 'measured'"),
        ("waypoints = [{ time_s = 0.0 }]\n", "waypoints 1: missing keys position_m"),
        (
            "waypoints = [{ time_s = 1, position_m = [0,0,0] }, { time_s = 0, position_m = [0,0,0] }]\n",
            "ascending",
        ),
        ("waypoints = 3\n", "waypoints: expected a list of tables"),
        ('pose_file = "none.txt"\n', "pose_file: cannot read"),
        ('pose_file = "bad.txt"\n', r"bad\.txt:2: expected 8 finite numbers"),
        ('pose_file = "skew.txt"\n', r"skew\.txt:1: expected a rotation"),
        ('pose_file = "long.txt"\n', r"long\.txt:2: expected a quaternion of length 1"),
        ('pose_file = "utm.txt"\n', "pose_file: expected positions within 1000 m of the start"),
        ('path_in = "there"\n', "path_in: expected one of start, world"),
        (
            '[[view.camera]]\nname = "image_00"\nlike = "image_00"\nwidth = 9\nheight = 9\nfocal_px = 5\n',
            "image_04",
        ),
        (
            '[[view.camera]]\nname = "image_09"\nlike = "image_00"\nwidth = 9\nheight = 9\n',
            "one of them; found neither",
        ),
        ('exports = ["e57"]\n', "exports: expected different ones of bin, ply"),
    ],
)  # fmt: skip
def test_a_view_that_cannot_be_is_refused_with_what_is_allowed(
    tmp_path: Path, lines: str, reason: str
) -> None:
    written(tmp_path / "bad.txt", "0 1 2 3 0 0 0 1\n1 2 3\n")
    written(tmp_path / "skew.txt", "0 1 2 3 4 5 6 7 8 9 10 11 12\n")
    written(tmp_path / "long.txt", "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 2\n")
    written(tmp_path / "utm.txt", "0 455000 5428000 110 0 0 0 1\n1 455001 5428000 110 0 0 0 1\n")
    with pytest.raises(DataError, match=rf"c\.toml.*{reason}"):
        load_catalogue([written(tmp_path / "c.toml", VIEW + lines)], None)


def test_the_page_of_the_catalogue_is_made_from_the_code() -> None:
    assert (REPOSITORY / "docs/catalogue.md").read_text() == as_markdown()
    for kind in (ViewEntry, SensorEntry, CameraEntry, Waypoint):
        assert all(f"| `{one.name}` |" in as_markdown() for one in fields(kind))


def test_an_absent_catalogue_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot read catalogue .*none\.toml"):
        load_catalogue([tmp_path / "none.toml"], None)
