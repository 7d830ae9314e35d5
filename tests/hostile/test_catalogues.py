"""Catalogues that ask for the impossible: refused as they are read, before training. One row a case."""

import os
from pathlib import Path

import pytest

from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.errors import DataError

SCENE = """
[[scene]]
name = "street"
root = "drive"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = 3
test_frames = [2]
"""
VIEW = SCENE + '[[view]]\nname = "v"\n'


def scene(key: str, value: str) -> str:
    """The scene with another value for a key, or with one more."""
    lines = [line for line in SCENE.splitlines() if not line.startswith(f"{key} =")]
    return "\n".join([*lines, f"{key} = {value}", ""])


CASES = [
    # Names that would lead elsewhere.
    ("a scene that climbs", scene("name", '"../victim"'), "a name is a folder"),
    ("a scene called ..", scene("name", '".."'), "a name is a folder"),
    ("three dots", scene("name", '"a...b"'), "no two dots in a row"),
    ("a NUL", scene("name", '"a\\u0000b"'), "only letters, digits"),
    ("an over-long name", scene("name", f'"{"a" * 300}"'), "at most 100 characters"),
    ("letters that look Latin", scene("name", '"d\u0435mo"'), "only letters, digits"),
    ("the report's name", scene("name", '"benchmark_report"'), "is reserved"),
    ("Dagster's folder", scene("name", '"dagster"'), "is reserved"),
    ("the record's name", SCENE + '[[view]]\nname = "stage.json"\n', "like a file of the store"),
    ("an array's name", SCENE + '[[view]]\nname = "model.zarr"\n', "like a file of the store"),
    ("a sequence that climbs", scene("sequence", '"../../etc"'), "sequence: a name is a folder"),
    ("a sequence of two parts", scene("sequence", '"a/b"'), "sequence: a name is a folder"),
    ("a root with a NUL", scene("root", '"a\\u0000b"'), "printable"),
    ("a root without end", scene("root", f'"{"a/" * 5000}"'), "1 to 1000 printable"),
    # Frames.
    ("a billion frames", scene("last_frame", "1_000_000_000"), "at most 20,000 frames"),
    ("frames beyond any file name", scene("last_frame", "1" + "0" * 30), "last_frame <= 9999999999"),
    ("a number of 5000 digits", scene("last_frame", "1" * 5000), "is no TOML"),
    ("true for a frame", scene("first_frame", "true"), "whole number"),
    ("half a frame", scene("first_frame", "0.5"), "whole number"),
    ("a held-out frame twice", scene("test_frames", "[2, 2]"), "distinct test_frames"),
    ("true held out", scene("test_frames", "[true]"), "test_frames: expected a tuple of frame numbers"),
    ("a turn of an hour", SCENE + "sweep_period_s = 3600\n", "0.01 to 2 seconds"),
    ("a turn of NaN", SCENE + "sweep_period_s = nan\n", "seconds of one sweep"),
    ("a recipe that is none", SCENE + 'recipe = "leen"\n', "no recipe 'leen'"),
    ("no share of a recipe", SCENE + 'recipe = "lean@nan"\n', "share of its rates"),
    ("a camera twice", SCENE + 'cameras = ["image_00", "image_00"]\n', "different ones"),
    # Views.
    ("a sensor that nobody makes", VIEW + 'sensor = "HDL-65"\n', "sensor: expected one of HDL-64E"),
    ("a format that nobody reads", VIEW + 'exports = ["las"]\n', "exports: expected different ones of bin"),
    ("a format twice", VIEW + 'exports = ["bin", "bin"]\n', "exports: expected different ones"),
    ("a shift to the moon", VIEW + "shift_m = [3.8e8, 0, 0]\n", "at most 1000 m"),
    ("a shift of a number without end", VIEW + f"shift_m = [1{'0' * 400}, 0, 0]\n", "shift_m: expected"),
    ("a shift of NaN", VIEW + "shift_m = [nan, 0, 0]\n", "shift_m: expected"),
    ("a turn without end", VIEW + "yaw_deg = inf\n", "yaw_deg: expected"),
    ("frames of another drive", VIEW + "frames = [7]\n", r"\[7\] are not in 0..3"),
    ("a frame twice", VIEW + "frames = [1, 1]\n", "once"),
    ("times before the drive", VIEW + "frames = [-1.0]\n", "frames: expected"),
    ("true images of no camera", VIEW + 'truth = { "../x" = "right" }\n', "truth: expected different cam"),
    ("true images with a NUL", VIEW + 'truth = { image_00 = "a\\u0000b" }\n', "1 to 1000 printable"),
    ("true images without end", VIEW + f'truth = {{ image_00 = "{"a/" * 5000}" }}\n', "1 to 1000 printable"),
    ("true images in a table", VIEW + 'truth = { image_00 = { a = "b" } }\n', "1 to 1000 printable"),
    # Files.
    ("brackets nested without end", "a = " + "[" * 5000, "is no TOML"),
    ("no scene at all", "# nothing\n", "expected at least one"),
    ("a key of a thousand parts", "a" + ".a" * 1000 + " = 1", "more than 20 parts"),
    ("a header of a thousand parts", "[a" + ".a" * 1000 + "]", "more than 20 parts"),
    ("a table of a thousand parts", "a = {b" + ".b" * 1000 + " = 1}", "more than 20 parts"),
    ("names that differ in case alone", SCENE + SCENE.replace("street", "Street"), "in case alone"),
    ("a home of nobody", scene("root", '"~nobody_of_that_name/x"'), "root: expected a path"),
    (
        "views without end",
        SCENE + "".join(f'[[view]]\nname = "v{k}"\n' for k in range(1001)),
        "at most 1000 views",
    ),
    ("no format at all", VIEW + "exports = []\n", "exports: expected"),
    ("no frame at all", VIEW + "frames = []\n", "frames: expected"),
    ("next to no step size", SCENE + 'recipe = "lean@1e-300"\n', "share of its rates"),
    ("a key twice", SCENE + "compensate = true\ncompensate = false\n", "is no TOML"),
    ("a file of 2 MiB", SCENE + "#" * (2 << 20), "at most 1,048,576 bytes"),
]


@pytest.mark.parametrize(("text", "words"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_the_impossible_is_refused_with_file_and_key(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=f"(?s){words}"):
        load_catalogue([path], None)


def test_a_pipe_for_a_catalogue_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "c.toml")
    with pytest.raises(DataError, match="regular file"):
        load_catalogue([tmp_path / "c.toml"], None)


def test_the_unharmed_catalogue_is_read(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIEW + "times_s = [0.15]\n")
    (entry,) = load_catalogue([tmp_path / "c.toml"], None)
    assert entry.name == "street" and entry.views[0].times_s == (0.15,)
