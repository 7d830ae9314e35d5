"""Labels are of their frame's time as recorded, also where the instants of scans are moved."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.detect import whole_drive
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_description, write_plain_boxes, write_plain_scan, write_poses
from nvsf_core.errors import CalibrationError
from nvsf_core.stages import plan_run, run_named_stage
from nvsf_core.stages.imports.convert import import_drive
from nvsf_core.stages.scoring.moving_boxes import read_moving_boxes
from nvsf_core.stages.views.instances import boxes_of
from nvsf_core.stores.tables import read_rows, write_rows

FRAMES, STEP_S, BEGIN_S, SPEED_M_S = 6, 0.1, 5.0, 6.0
LABELLED = range(1, FRAMES - 1)


def car(clock_s: float) -> np.ndarray:
    """A car (4, 4) that drives ahead, at a time of the drive's clock."""
    box = np.diag([4.2, 1.8, 1.5, 1.0])
    box[:3, 3] = 10.0 + SPEED_M_S * (clock_s - BEGIN_S), 3.0, 0.75
    return box


def write_drive(root: Path, points_s: np.ndarray | None, boxes_after_s: float = 0.0) -> SceneEntry:
    """A drive at 8 m/s whose points have these times after their scan's stamp."""
    layout = PlainLayout(root)
    write_description(layout, "VLP-16", boxes_after_s=boxes_after_s)
    moments_s = BEGIN_S + STEP_S * np.arange(FRAMES + 1)
    poses = np.tile(np.eye(4), (FRAMES + 1, 1, 1))
    poses[:, 0, 3] = 8.0 * (moments_s - BEGIN_S)
    write_poses(layout, range(FRAMES + 1), moments_s.tolist(), list(poses))
    angle = np.linspace(np.pi, -np.pi, 200, endpoint=False)
    rows = np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), 0.0 * angle, 0.5 + 0.0 * angle], axis=1)
    for frame in range(FRAMES):
        write_plain_scan(layout, frame, Scan(rows.astype(np.float32), 0, offset_s=points_s))
    write_plain_boxes(layout, [
        Box(
            frame=frame, object_id=7, label="car", dynamic=True,
            box_to_world=car(BEGIN_S + STEP_S * frame + boxes_after_s),
        )
        for frame in LABELLED
    ])  # fmt: skip
    return replace(whole_drive(root, "plain", first=0, last=FRAMES - 1), test_frames=(2,))


def require_cars_place(scene: SceneEntry, home: Path, instant_s: float) -> list[dict]:
    """Rows of the drive's frames; boxes are where the car is when a scan or an image of them is taken.

    The instant of a frame is so long after its time as recorded.
    """
    run = plan_run(scene, home, recipe="smoke")
    run_named_stage("frames", run, lambda line: None)
    with run.store.publish("evidence") as folder:
        write_rows(folder / "moving.parquet", [], ["object_id", "time_s", "box_to_world"])
    boxes, at = read_moving_boxes(run.store), boxes_of(run.store)
    assert boxes is not None
    rows = read_rows(run.store.path("frames") / "frames.parquet")
    for row in rows[LABELLED.start : LABELLED.stop]:
        frame, scan_s = row["frame"], row["time_s"]
        # Of its first and last frame an object is known at the label and at the scan, not at other images.
        known_s = [scan_s] if frame in (LABELLED[0], LABELLED[-1]) else [scan_s, scan_s - instant_s]
        views = [one.box_to_world for time_s in known_s for one in at(time_s)]
        np.testing.assert_allclose(
            views, [car(BEGIN_S + instant_s + time_s) for time_s in known_s], atol=1e-6
        )
        for time_s in (scan_s, scan_s - instant_s):
            images = boxes.in_camera(frame, time_s, np.eye(4))
            np.testing.assert_allclose(images, [car(BEGIN_S + instant_s + time_s)], atol=1e-6)
        scans = np.array(row["lidar_to_world"]).reshape(4, 4) @ boxes.in_lidar(frame)
        np.testing.assert_allclose(scans, [car(BEGIN_S + instant_s + scan_s)], atol=1e-6)
    assert at(rows[0]["time_s"]) == at(rows[-1]["time_s"]) == [], "known in neither of these frames"
    return rows


@pytest.mark.parametrize("boxes_after_s", [0.0, 0.03, -0.02])
@pytest.mark.parametrize("begin_s", [0.0, -0.1], ids=["stamped at begin", "stamped at end"])
def test_a_box_is_where_the_object_was_also_where_the_scans_instant_is_moved(
    tmp_path: Path, begin_s: float, boxes_after_s: float
) -> None:
    points_s = begin_s + np.linspace(0.0, STEP_S, 200)
    scene = write_drive(tmp_path / "drive", points_s, boxes_after_s)
    instant_s = begin_s + 0.5 * STEP_S
    rows = require_cars_place(scene, tmp_path / "home", instant_s)
    assert [row.get("boxes_time_s", row["time_s"]) for row in rows] == pytest.approx(
        [row["time_s"] - instant_s + boxes_after_s for row in rows], abs=1e-6
    )
    done = import_drive(scene, tmp_path / "again", progress=lambda line: None)
    require_cars_place(
        replace(whole_drive(done.folder, "plain"), test_frames=(2,)), tmp_path / "home_again", instant_s
    )


def test_of_labels_at_their_scans_instants_no_time_is_stored(tmp_path: Path) -> None:
    scene = write_drive(tmp_path / "drive", None)
    assert "boxes_time_s" not in require_cars_place(scene, tmp_path / "home", 0.0)[0]
    done = import_drive(scene, tmp_path / "again", progress=lambda line: None)
    assert "boxes_after_s" not in json.loads((done.folder / "drive.json").read_text())


def test_kitti360s_layout_says_that_it_loses_the_labels_time(tmp_path: Path) -> None:
    scene = write_drive(tmp_path / "drive", np.linspace(0.0, STEP_S, 200))
    done = import_drive(scene, tmp_path / "out", layout="kitti360", progress=lambda line: None)
    assert any(one.startswith("times of boxes, -50.0 ms from their frames'") for one in done.left_out)


@pytest.mark.parametrize("value", ['"0.05"', "true", "NaN", "50"])
def test_a_labels_time_in_another_unit_is_refused(tmp_path: Path, value: str) -> None:
    scene = write_drive(tmp_path / "drive", None)
    PlainLayout(scene.root).drive_path.write_text(f'{{"lidar": "VLP-16", "boxes_after_s": {value}}}')
    with pytest.raises(CalibrationError, match="boxes_after_s: expected seconds"):
        import_drive(scene, tmp_path / "out", progress=lambda line: None)
