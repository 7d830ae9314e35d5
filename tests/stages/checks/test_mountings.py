"""Cameras' mountings are checked against what scans and images show."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.demo.cameras import LIDAR_TO_POSE
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.runner.stage import Check

SIZE = DemoSize(
    frames=9, lasers=tuple(range(0, 64, 2)), firings=256, cameras=(), width=352, height=94,
    fisheye_side=176,
)  # fmt: skip
TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("mounted") / "drive"
    write_demo(root, size=SIZE)
    return root


def _check(root: Path) -> Check:
    scene = SceneEntry(
        name="mounted", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=8, test_frames=(4,)
    )  # fmt: skip
    run = plan_run(scene, root.parent / "home", recipe="smoke")
    outcomes = [run_named_stage(stage, run, lambda line: None) for stage in ("frames", "sweeps")]
    (check,) = [one for one in outcomes[1].checks if one.name == "cameras_are_mounted_as_given"]
    return check


def test_a_camera_mounted_as_given_passes(drive):
    check = _check(drive)
    assert check.passed and check.value < 1.0 and not check.blocking
    assert check.detail == "of 1 cameras 0 are mounted otherwise"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (np.linalg.inv, "image_02: the pose is inverted: write the camera's in the LiDAR's frame"),
        (lambda in_lidar: TURNED @ in_lidar, "turned by 180 degrees about the LiDAR's z"),
        (lambda in_lidar: in_lidar @ TURNED, "turned by 180 degrees about the optical axis"),
    ],
    ids=["inverted", "looking back", "upside down"],
)  # fmt: skip
def test_a_wrong_mounting_is_doubted_and_the_right_one_told(drive, tmp_path, wrong, words):
    shutil.copytree(drive, tmp_path / "drive")
    path = DriveLayout(tmp_path / "drive", DEMO_SEQUENCE).cam_to_pose_path
    lines = path.read_text().splitlines()
    (k,) = [k for k, line in enumerate(lines) if line.startswith("image_02:")]
    to_pose = np.vstack([np.array(lines[k].split()[1:], np.float64).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    to_pose = LIDAR_TO_POSE @ wrong(np.linalg.inv(LIDAR_TO_POSE) @ to_pose)
    lines[k] = " ".join(["image_02:", *(f"{value:.12f}" for value in to_pose[:3].ravel())])
    path.write_text("\n".join(lines))
    check = _check(tmp_path / "drive")
    assert not check.passed and words in check.detail


def test_without_a_camera_nothing_is_said(drive, tmp_path):
    shutil.copytree(drive, tmp_path / "drive", ignore=shutil.ignore_patterns("data_2d_raw", "image_02.yaml"))
    assert _check(tmp_path / "drive").detail.startswith("not run: no camera sees enough")
