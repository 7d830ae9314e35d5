"""Drives with something wrong: refused by name, or a doubt that the report shows. One row a case."""

import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.drive import DEMO_SEQUENCE
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.errors import NvsfError
from nvsf_core.stages import plan_run, run_named_stage
from tests.hostile import harm

FISHEYE = """%YAML:1.0
model_type: {model}
image_width: {width}
image_height: 48
mirror_parameters:
   xi: 2.2
distortion_parameters:
   k1: {k1}
   k2: 1.6
   p1: 0.0
   p2: 0.0
projection_parameters:
   gamma1: 60.0
   gamma2: 60.0
   u0: 31.0
   v0: 23.0
"""


@dataclass(frozen=True)
class Refused:
    """An NvsfError whose message has these words."""

    words: str


@dataclass(frozen=True)
class Doubted:
    """A check of this name fails, and says these words."""

    check: str
    words: str = ""


Outcome = Refused | Doubted
NOTES = "notes"
"""Not a check: what the stage `frames` says that it assumed or left out."""


def scan(layout: DriveLayout) -> Path:
    return layout.scan_path(1)


def image(layout: DriveLayout) -> Path:
    return layout.image_path("image_00", 1)


def boxes(layout: DriveLayout) -> Path:
    return layout.boxes_paths[0]


def times(layout: DriveLayout) -> Path:
    return layout.timestamps_path()


PERSPECTIVE = attrgetter("perspective_path")
POSES = attrgetter("poses_path")


def at(place: Callable[[DriveLayout], Path], done: harm.Harm) -> Callable[[DriveLayout], None]:
    """Harm done to one file of a drive."""
    return lambda layout: done(place(layout))


def pose(frame: int, change: Callable[[np.ndarray], None]) -> Callable[[DriveLayout], None]:
    """Harm done to one frame's 12 numbers."""
    return lambda layout: harm.poses(layout.poses_path, lambda rows: change(rows[frame, 1:]))


def _far(matrix: np.ndarray, metres: float) -> None:
    matrix[3] = metres


def _skewed(matrix: np.ndarray, by: float) -> None:
    matrix[0] *= 1.0 + by


def _fisheye(**values: object) -> Callable[[DriveLayout], None]:
    def done(layout: DriveLayout) -> None:
        source = layout.image_path("image_00", 0).parent
        target = layout.camera_dir("image_02")
        shutil.copytree(source, target)
        layout.fisheye_path("image_02").write_text(
            FISHEYE.format(**({"model": "MEI", "width": 64, "k1": 0.01} | values))
        )

    return done


def _same_scan(layout: DriveLayout) -> None:
    for frame in (1, 2, 3):
        shutil.copy(layout.scan_path(0), layout.scan_path(frame))


MANY_KEYS = "".join(f"key_{k}: 1\n" for k in range(100_000))

CASES: list[tuple[str, Callable[[DriveLayout], None], Outcome]] = [
    # Sizes: nothing large is read before it is known to be possible.
    (
        "a sparse scan of 20 GB",
        at(scan, harm.sparse(20)),
        Doubted("all_scans_are_usable", "at most 16,777,216 bytes"),
    ),
    (
        "a scan of ten million points",
        at(scan, harm.sparse(0.15)),
        Doubted("all_scans_are_usable", "bytes, found"),
    ),
    ("a pipe for a scan", at(scan, harm.pipe), Doubted("all_scans_are_usable", "a pipe or a device")),
    (
        "a device for an image",
        at(image, harm.endless),
        Doubted("all_images_are_usable", "a pipe or a device"),
    ),
    (
        "a sparse image",
        at(image, harm.sparse(2)),
        Doubted("all_images_are_usable", "at most 1,060,864 bytes"),
    ),
    (
        "a header that claims 20,000 x 20,000 pixels",
        at(image, lambda path: harm.png(path, claims=(20_000, 20_000))),
        Doubted("all_images_are_usable", "expected 64 x 48 .* found 20000 x 20000"),
    ),
    ("a pipe for poses", at(POSES, harm.pipe), Refused("poses.txt .*regular file")),
    ("a device for times", at(times, harm.endless), Refused("timestamps.txt .*regular file")),
    ("a folder for a calibration", at(PERSPECTIVE, harm.folder), Doubted(NOTES, "image_00 left out")),
    (
        "eight million keys",
        at(PERSPECTIVE, harm.text(MANY_KEYS)),
        Refused("perspective.txt .*1,048,576 bytes"),
    ),
    ("poses of 20 GB", at(POSES, harm.sparse(20)), Refused("poses.txt .*expected at most")),
    ("boxes of 20 GB", at(boxes, harm.sparse(20)), Refused("xml, .*expected at most")),
    # Numbers that no camera, mounting or place has.
    (
        "a focal of 1e-300",
        at(PERSPECTIVE, harm.replaced(r"(P_rect_00: )\S+", r"\g<1>1e-300")),
        Refused("perspective.txt, line .*P_rect_00.*focal lengths of 0.05 to 50 image widths"),
    ),
    ("a focal of 1e30", at(PERSPECTIVE, harm.replaced(r"(P_rect_00: )\S+", r"\g<1>1e30")), Refused("focal")),
    (
        "an axis far outside",
        at(PERSPECTIVE, harm.replaced(r"(P_rect_00: \S+ \S+ )\S+", r"\g<1>9000")),
        Refused("optical axis near the image"),
    ),
    (
        "half a pixel of width",
        at(PERSPECTIVE, harm.replaced(r"(S_rect_00: )\S+", r"\g<1>64.5")),
        Refused("whole image sides"),
    ),
    (
        "a third row of zeros",
        at(PERSPECTIVE, harm.replaced(r"(P_rect_00:.*) 1\.0+ (\S+)$", r"\1 0.0 \2")),
        Refused(r"rows \(fx 0 cx .\)"),
    ),
    ("a key twice", at(PERSPECTIVE, harm.replaced(r"^(S_rect_00.*)$", r"\1\n\1")), Refused("stands in line")),
    (
        "a LiDAR a kilometre away",
        at(attrgetter("cam_to_velo_path"), harm.replaced(r"^(\S+ \S+ \S+) \S+", r"\1 1000")),
        Refused("calib_cam_to_velo.txt.*within 100 m"),
    ),
    (
        "a fisheye that is not MEI",
        _fisheye(model="PINHOLE"),
        Refused("image_02.yaml, line 2, model_type.*MEI"),
    ),
    ("a fisheye without distortion's bounds", _fisheye(k1=1e9), Refused("image_02.yaml.*k1")),
    ("a fisheye of half a pixel", _fisheye(width=63.5), Refused("image_02.yaml.*whole image sides")),
    # Poses.
    (
        "poses at 1e12 m",
        lambda layout: harm.poses(layout.poses_path, lambda rows: rows[:, 4].__iadd__(1e12)),
        Refused("poses.txt, line 1: frame 0: expected a translation within 3e"),
    ),
    ("one pose at 1e9 m", pose(2, lambda m: _far(m, 1e9)), Refused("line 3: frame 2")),
    ("one pose ten kilometres off", pose(2, lambda m: _far(m, 1e4)), Refused("no_pose_jumps: .*frame 2")),
    ("a rotation of few digits is straightened", pose(1, lambda m: _skewed(m, 1e-4)), Doubted("")),
    (
        "a rotation off by a tenth",
        pose(1, lambda m: _skewed(m, 0.1)),
        Refused("frame 1: expected a rotation"),
    ),
    (
        "no frame's last row",
        at(attrgetter("cam0_to_world_path"), harm.replaced(r"1(\.0+)?$", "2")),
        Refused("last row 0 0 0 1"),
    ),
    # Times in other units.
    ("a frame an hour", at(times, harm.stamps(3600.0)), Doubted("timestamps_are_usable", "another unit")),
    ("a frame a year", at(times, harm.stamps(3.2e7)), Doubted("timestamps_are_usable", "another unit")),
    ("a frame a millisecond", at(times, harm.stamps(1e-3)), Doubted("timestamps_are_usable", "0.01")),
    ("a pause of a day", at(times, harm.stamps(0.1, 86400.0)), Doubted("timestamps_are_usable")),
    ("years alone", at(times, harm.text("2013\n2014\n2015\n2016\n")), Refused("timestamps.txt, line 1")),
    # Images.
    (
        "12 bits in 16",
        at(image, lambda path: harm.png(path, depth=16)),
        Doubted("all_images_are_usable", "8 bits"),
    ),
    (
        "a turned image",
        at(image, lambda path: harm.png(path, orientation=6)),
        Doubted("all_images_are_usable", "EXIF orientation 6"),
    ),
    ("half of an image's rows", at(image, harm.too_few_pixels), Doubted("all_images_are_usable", "too few")),
    (
        "images all the same",
        lambda layout: shutil.copy(layout.image_path("image_00", 0), image(layout)),
        Doubted("every_image_of_image_00_is_another", "frames 0, 1"),
    ),
    # Scans.
    ("scans all the same", _same_scan, Doubted("every_scan_is_another", "frames 0, 1, 2, 3")),
    (
        "two scans swapped",
        lambda layout: harm.swap(layout.scan_path(1), layout.scan_path(2)),
        Doubted("scans_fit_their_own_poses_best"),
    ),
    (
        "intensities of 0",
        lambda layout: harm.scans(layout, lambda rows: rows * [1, 1, 1, 0]),
        Doubted("intensities_are_recorded"),
    ),
    (
        "one scan cut between two returns",
        at(scan, lambda path: path.write_bytes(path.read_bytes()[:1600])),
        Doubted("scans_are_of_one_size", "1: 100"),
    ),
    (
        "one scan without intensities",
        at(scan, lambda path: harm.rows(path, lambda r: r * [1, 1, 1, 0])),
        Doubted("intensities_are_recorded", "frames 1"),
    ),
    (
        "more firings than the encoder has steps",
        lambda layout: harm.scans(layout, harm.crowded),
        Doubted("no_two_returns_share_a_firing"),
    ),
    (
        "a pipe for the scans' folder",
        at(lambda layout: layout.scan_path(0).parent, harm.no_folder),
        Refused("data: expected a folder"),
    ),
    (
        "a pipe for the images' folder",
        at(lambda layout: layout.camera_dir("image_00"), harm.no_folder),
        Refused("data_rect: expected a folder"),
    ),
    ("a black image", at(image, harm.black), Doubted("all_images_are_usable", "one value in all pixels")),
    ("a mirrored pose", pose(1, lambda m: m.__setitem__(slice(0, 3), -m[:3])), Refused("a mirror in it")),
    (
        "two frames a microsecond apart",
        at(times, harm.stamps(0.1, -0.099999)),
        Doubted("timestamps_are_usable"),
    ),
    (
        "a byte order mark",
        at(PERSPECTIVE, lambda path: path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())),
        Doubted(""),
    ),
    (
        "a name that is no text",
        lambda layout: (layout.calibration_dir / os.fsdecode(b"a\xff")).touch(),
        Doubted(""),
    ),
    (
        "a million lines of poses",
        at(POSES, lambda path: path.write_text("\n" * 1_000_000)),
        Refused("100,000 lines"),
    ),
    # Boxes.
    (
        "a flat box",
        at(boxes, harm.replaced(r"(?s:(<transform.*?<data>)[^<]*)", r"\g<1>" + "0 " * 15 + "1")),
        Doubted("all_boxes_are_usable", "sides of"),
    ),
    (
        "a misspelt transform",
        lambda layout: boxes(layout).write_text(boxes(layout).read_text().replace("transform", "tranform")),
        Refused("field 'transform' is missing"),
    ),
    (
        "boxes in no encoding of text",
        at(boxes, harm.text('<?xml version="1.0" encoding="rot13"?><a/>')),
        Refused("cannot read boxes"),
    ),
    ("boxes in UTF-7", at(boxes, harm.text('<?xml version="1.0" encoding="utf-7"?><a/>')), Refused("boxes")),
    (
        "a comment of 8 MiB",
        at(boxes, harm.text("<a><!--" + " " * (8 << 20) + "--></a>")),
        Refused("one `>` to the next"),
    ),
    (
        "a box of a hundred thousand parts",
        at(boxes, harm.text("<a><b>" + "<c/>" * 100_000 + "</b></a>")),
        Refused("boxes of 100 elements"),
    ),
    ("nested boxes", at(boxes, harm.text("<a>" * 1000)), Refused("8 deep")),
    (
        "an entity that unfolds",
        at(boxes, harm.text('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>')),
        Refused("boxes"),
    ),
    (
        "a number of rows without end",
        at(boxes, harm.replaced(r"<rows>\d+", "<rows>" + "9" * 400)),
        Refused("rows"),
    ),
    (
        "an object without end",
        at(boxes, harm.replaced(r"<semanticId>\d+", "<semanticId>" + "9" * 30)),
        Refused("semanticId: expected a whole number"),
    ),
    (
        "digits of another script",
        at(boxes, harm.replaced(r"<instanceId>\d+", "<instanceId>\u0663")),
        Refused("instanceId"),
    ),
    (
        "a box beyond the horizon",
        at(
            boxes,
            harm.replaced(r"(?s:(<transform.*?<data>)[^<]*)", r"\g<1>4 0 0 5e6 0 2 0 5e6 0 0 1.5 0 0 0 0 1"),
        ),
        Doubted("all_boxes_are_usable", "20000 m away"),
    ),
]


@pytest.fixture(scope="module")
def clean(tiny_catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Checks that the unharmed drive fails already."""
    return set(_doubts(tiny_catalogue.parent / "drive", tmp_path_factory.mktemp("clean") / "home"))


@pytest.mark.parametrize(("done", "outcome"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_a_harmed_drive_is_refused_or_doubted(
    tiny_catalogue: Path,
    tmp_path: Path,
    clean: set[str],
    done: Callable[[DriveLayout], None],
    outcome: Outcome,
) -> None:
    shutil.copytree(tiny_catalogue.parent / "drive", tmp_path / "drive")
    done(DriveLayout(tmp_path / "drive", DEMO_SEQUENCE))
    if isinstance(outcome, Refused):
        with pytest.raises(NvsfError, match=outcome.words):
            _doubts(tmp_path / "drive", tmp_path / "home")
        return
    doubts = _doubts(tmp_path / "drive", tmp_path / "home", outcome.check)
    if not outcome.check:
        assert set(doubts) <= clean
        return
    assert outcome.check in doubts and outcome.check not in clean - {NOTES}, doubts
    assert re.search(outcome.words, doubts[outcome.check]), doubts[outcome.check]


def _doubts(drive: Path, home: Path, until: str = "") -> dict[str, str]:
    """Checks that fail, with their words; no further than to the stage where the one looked for does."""
    scene = SceneEntry(
        name="tiny", root=drive, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=3, test_frames=(2,)
    )
    run = plan_run(scene, home, recipe="smoke")
    found: dict[str, str] = {}
    for stage in ("frames", "sweeps", "undistorted"):
        outcome = run_named_stage(stage, run, lambda line: None)
        found |= {check.name: check.detail for check in outcome.checks if not check.passed}
        found |= {NOTES: str(outcome.metadata[NOTES])} if NOTES in outcome.metadata else {}
        if until in found:
            break
    return found
