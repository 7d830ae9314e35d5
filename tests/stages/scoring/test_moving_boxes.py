"""Boxes of moving objects in images that were taken at times of their own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nvsf_core.geometry.boxes import box_rectangles
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.metrics.elementwise import PSNR_CAP_DB
from nvsf_core.stages.scoring.camera import measure_camera
from nvsf_core.stages.scoring.moving_boxes import MovingBoxes, read_moving_boxes
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stores.arrays import write_arrays
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import write_rows

FRAMES, PERIOD_S, DELAY_S = 4, 0.1, 0.04
CAMERA = Pinhole(fx=60.0, fy=60.0, cx=47.5, cy=31.5, width=96, height=64)
LOOKS = np.array([[0.0, 0.0, 1.0, 1000.0], [-1.0, 0.0, 0.0, 3700.0], [0.0, -1.0, 0.0, 100.0], [0, 0, 0, 1]])
"""Camera to world: along the world's x."""


def box(time_s: float) -> np.ndarray:
    """A car 12 m ahead that drives to the left at 10 m/s."""
    found = np.diag([2.0, 4.0, 1.5, 1.0])
    found[:3, 3] = LOOKS[:3, 3] + (12.0, 10.0 * time_s - 2.0, 0.0)
    return found


def seen(time_s: float) -> np.ndarray:
    """(H, W) bool: its pixels."""
    return box_rectangles(CAMERA, invert_pose(LOOKS) @ box(time_s)[None])


@pytest.fixture
def store(tmp_path: Path) -> SceneStore:
    found = SceneStore(home=tmp_path, scene="beside")
    frames = found.path("frames")
    frames.mkdir(parents=True)
    pose = {"pose_valid": True, "lidar_to_world": np.eye(4).ravel().tolist()}
    rows = [{"frame": frame, "time_s": frame * PERIOD_S, **pose} for frame in range(FRAMES)]
    write_rows(frames / "frames.parquet", rows, list(rows[0]))
    boxes: list[dict[str, Any]] = [
        {
            "frame": frame, "object_id": 7, "dynamic": True,
            "box_to_world": box(frame * PERIOD_S).ravel().tolist(),
        }
        for frame in range(FRAMES)
    ]  # fmt: skip
    write_rows(frames / "boxes.parquet", boxes, list(boxes[0]))
    return found


def boxes_of(store: SceneStore) -> MovingBoxes:
    found = read_moving_boxes(store)
    assert found is not None
    return found


def test_a_box_is_where_the_object_was_when_the_image_was_taken(store: SceneStore) -> None:
    boxes = boxes_of(store)
    for frame, time_s in ((1, 0.1), (1, 0.14), (1, 0.06), (3, 0.34), (0, -0.03), (0, 0.15)):
        (here,) = boxes.in_camera(frame, time_s, LOOKS)
        np.testing.assert_allclose(here, invert_pose(LOOKS) @ box(time_s), atol=1e-9, err_msg=f"{time_s}")
    (here,) = boxes.in_camera(2, 2 * PERIOD_S, LOOKS)
    assert np.array_equal(here, invert_pose(LOOKS) @ box(2 * PERIOD_S)), "at the frame's instant as annotated"
    assert boxes.in_camera(FRAMES, 0.4, LOOKS).shape == boxes.in_lidar(0)[:0].shape == (0, 4, 4)


def test_a_box_whose_heading_flips_between_two_frames_is_not_flat_in_an_image_between(
    store: SceneStore,
) -> None:
    boxes = boxes_of(store)
    boxes.to_world[2][7] = boxes.to_world[2][7] * [-1.0, -1.0, 1.0, 1.0]
    (here,) = boxes.in_camera(1, 0.15, LOOKS)
    np.testing.assert_allclose(here, invert_pose(LOOKS) @ box(0.15), atol=1e-9)


def test_the_foreground_of_a_late_image_is_at_the_images_own_instant(store: SceneStore) -> None:
    shown = np.random.default_rng(0).integers(0, 255, (FRAMES, 64, 96, 3), np.uint8)
    frame = np.arange(FRAMES)
    images = store.path("undistorted") / "images.zarr"
    true = {
        "front_rgb": shown, "front_valid": np.ones((64, 96), bool), "front_frame": frame,
        "front_time_s": frame * PERIOD_S + DELAY_S, "front_camera_to_world": np.stack([LOOKS] * FRAMES),
    }  # fmt: skip
    facts = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    write_arrays(images, true, {"cameras": {"front": facts}})
    # Rendered is what was recorded, but for the car's own pixels.
    rendered = shown.copy()
    for one in (1, 2):
        rendered[one][seen(one * PERIOD_S + DELAY_S)] += 1
    view = store.path("novel_views/smoke/0/test") / "model.zarr"
    held_out = {
        "front_rgb": rendered[1:3], "front_frame": frame[1:3], "front_render_seconds": np.full(2, 0.1),
    }  # fmt: skip
    write_arrays(view, held_out, {"cameras": ["front"]})
    ledger = Ledger(facts={})
    list(measure_camera(view, images, "front", boxes_of(store), None, ledger, None))
    rows = [row for row in ledger.rows if (row["protocol"], row["metric"]) == ("masked", "image_psnr_db")]
    counts = {(row["region"], row["frame"]): row["n_valid"] for row in rows}
    assert counts["foreground", 1] == np.count_nonzero(seen(PERIOD_S + DELAY_S))
    background = [row["value"] for row in rows if row["region"] == "background"]
    assert background == [PSNR_CAP_DB] * 2, "no pixel of the car is in the background"
