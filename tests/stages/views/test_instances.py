"""Instance images show which box each pixel's surface lies in, labelled or found; depth is along the axis."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.geometry.camera_fan import camera_rays
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import pose_of_angles
from nvsf_core.stages.exports.records import BoxRecord
from nvsf_core.stages.views.instances import boxes_of, depth_m, instance_arrays, object_ids
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import write_rows

_PINHOLE = Pinhole(fx=60.0, fy=60.0, cx=40.0, cy=30.0, width=80, height=60)
_FISHEYE = MeiFisheye(
    xi=2.2, k1=0.02, k2=1.5, p1=0.0, p2=0.0, gamma1=133.0, gamma2=133.0, u0=70.0, v0=70.0, width=140,
    height=140,
)  # fmt: skip
_POSE = pose_of_angles((1000.0, 3700.0, 115.0), 30.0, 2.0, 0.0) @ np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def _box(object_id: int, ahead_m: float, right_m: float, side_m: float) -> BoxRecord:
    """A cube in front of the camera."""
    pose = np.eye(4)
    pose[:3, 3] = right_m, 0.0, ahead_m
    size = np.diag([side_m, side_m, side_m, 1.0])
    return BoxRecord(object_id=object_id, label="car", is_dynamic=True, box_to_world=_POSE @ pose @ size)


def _wall(model: Pinhole | MeiFisheye, ahead_m: float) -> np.ndarray:
    """Lengths (H, W) of the pixels' rays to a wall across the axis."""
    z = camera_rays(model)[0][..., 2]
    return np.where(z > 0.05, ahead_m / np.where(z > 0.05, z, 1.0), np.inf)


def _arrays(model: Pinhole | MeiFisheye, range_m: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "frame": np.array([3]), "time_s": np.array([0.3]), "image_00_frame": np.array([3]),
        "image_00_time_s": np.array([0.3]),
        "image_00_rgb": np.zeros((1, model.height, model.width, 3), np.uint8),
        "image_00_range_m": range_m[None].astype(np.float16), "image_00_camera_to_world": _POSE[None],
    }  # fmt: skip


@pytest.mark.parametrize("model", [_PINHOLE, _FISHEYE])
def test_a_pixel_is_of_the_smallest_box_that_its_surface_lies_in(model: Pinhole | MeiFisheye) -> None:
    range_m = _wall(model, 10.0)
    boxes = [_box(26_001, 10.0, 0.0, 2.0), _box(26_002, 10.0, 0.0, 6.0), _box(26_003, 14.0, 3.0, 2.0)]
    found, table = instance_arrays(_arrays(model, range_m), {"image_00": model}, lambda index: boxes)
    shown = object_ids(found["image_00_instance"][0], table)
    points_m = camera_rays(model)[0] * np.where(np.isfinite(range_m), range_m, 1e6)[..., None]
    off_m = np.abs(points_m[..., :2]).max(axis=-1)
    assert (shown[off_m < 0.9] == 26_001).all() and (off_m < 0.9).sum() > 20
    assert (shown[(off_m > 1.2) & (off_m < 2.9)] == 26_002).all()
    assert (shown[~(off_m < 3.2)] == 0).all(), "the third box lies behind the wall"
    assert [row["object_id"] for row in table] == [26_001, 26_002, 26_003]


def test_pixels_without_a_range_and_views_without_boxes_have_no_object() -> None:
    arrays = _arrays(_PINHOLE, np.full((60, 80), np.inf))
    found, _ = instance_arrays(arrays, {"image_00": _PINHOLE}, lambda index: [_box(26_001, 10.0, 0.0, 50.0)])
    assert found["image_00_instance"].dtype == np.uint16 and not found["image_00_instance"].any()
    assert instance_arrays(arrays, {"image_00": _PINHOLE}, lambda index: []) == ({}, [])


def test_a_box_beside_and_around_the_camera_is_found_by_its_points() -> None:
    arrays = _arrays(_PINHOLE, _wall(_PINHOLE, 4.0))
    around, behind = _box(26_001, 0.0, 0.0, 9.0), _box(26_002, -5.0, 0.0, 2.0)
    found, table = instance_arrays(arrays, {"image_00": _PINHOLE}, lambda index: [around, behind])
    assert (object_ids(found["image_00_instance"][0], table) == 26_001).all()


def test_depth_of_a_wall_is_the_same_in_all_pixels_of_a_pinhole_and_the_range_of_a_fisheye() -> None:
    assert np.allclose(depth_m(_PINHOLE, _wall(_PINHOLE, 7.5)), 7.5, atol=1e-5)
    range_m = _wall(_FISHEYE, 7.5)
    known = np.isfinite(range_m)
    depth = depth_m(_FISHEYE, range_m)
    assert np.allclose(depth[known], range_m[known]) and (depth[~known] == 0.0).all()


def _track(object_id: int, x_m: float, side_m: float, **other: object) -> list[dict]:
    """Boxes of an object that moves along y at 10 m/s."""
    rows = []
    for frame in range(4):
        box = np.diag([side_m, side_m, side_m, 1.0])
        box[:3, 3] = x_m, frame, 0.5
        rows.append({"object_id": object_id, "box_to_world": box.ravel().tolist(), "frame": frame} | other)
    return rows


def _boxes(home: Path, labelled: list[dict], found: list[dict], time_s: list[float]) -> list[list[BoxRecord]]:
    """Boxes of a drive of four frames at some instants."""
    store = SceneStore(home, "street")
    frames = [{"frame": frame, "time_s": 0.1 * frame} for frame in range(4)]
    with store.publish("frames") as folder:
        write_rows(folder / "frames.parquet", frames, ["frame", "time_s"])
        write_rows(
            folder / "boxes.parquet", labelled, ["frame", "object_id", "label", "dynamic", "box_to_world"]
        )
    with store.publish("evidence") as folder:
        rows = [{**row, "time_s": 0.1 * row["frame"] + 0.01} for row in found]
        write_rows(folder / "moving.parquet", rows, ["object_id", "time_s", "box_to_world"])
    at = boxes_of(store)
    return [list(at(one)) for one in time_s]


def test_what_moves_without_a_label_has_a_box_and_what_has_one_is_not_doubled(tmp_path: Path) -> None:
    labelled = _track(26_004, 0.0, 2.0, label="car", dynamic=True)
    found = _track(1, 0.3, 1.8) + _track(2, 9.0, 0.6)
    later, first = _boxes(tmp_path, labelled, found, [0.16, 0.0])
    assert [(one.object_id, one.label, one.is_dynamic) for one in later] == [
        (26_004, "car", True), (26_006, "dynamic", True),
    ]  # fmt: skip
    np.testing.assert_allclose(later[1].box_to_world[:3, 3], [9.0, 1.5, 0.5])
    assert [one.object_id for one in first] == [26_004], "before its first scan nothing is known of it"


def test_a_box_between_two_labels_whose_heading_flips_is_neither_flat_nor_turned(tmp_path: Path) -> None:
    labelled = _track(26_004, 0.0, 2.0, label="car", dynamic=True)
    flipped = np.array(labelled[2]["box_to_world"]).reshape(4, 4) * [-1.0, -1.0, 1.0, 1.0]
    labelled[2]["box_to_world"] = flipped.ravel().tolist()
    for time_s, ((box,)) in zip((0.15, 0.24), _boxes(tmp_path, labelled, [], [0.15, 0.24]), strict=True):
        expected = np.diag([2.0, 2.0, 2.0, 1.0])
        expected[:3, 3] = 0.0, 10.0 * time_s, 0.5
        if time_s > 0.2:
            expected = expected * [-1.0, -1.0, 1.0, 1.0]
        np.testing.assert_allclose(box.box_to_world, expected, atol=1e-9)


@pytest.mark.parametrize("label", ["car", "unknownVehicle", "Person (sitting)", "vehicle.bus.rigid"])
def test_what_moves_in_a_static_box_of_what_can_move_is_that_object(tmp_path: Path, label: str) -> None:
    parked = _track(26_004, 0.0, 9.0, label=label, dynamic=False)[0] | {"frame": -1}
    (boxes,) = _boxes(tmp_path, [parked], _track(1, 0.3, 0.6), [0.16])
    assert [one.object_id for one in boxes] == [26_004]


@pytest.mark.parametrize("label", ["building", "fence", "vegetation", "trafficSign", "bus stop", "unknown"])
def test_what_moves_in_a_static_box_of_what_cannot_keeps_its_own(tmp_path: Path, label: str) -> None:
    house = _track(11_004, 0.0, 9.0, label=label, dynamic=False)[0] | {"frame": -1}
    (boxes,) = _boxes(tmp_path, [house], _track(1, 0.3, 0.6), [0.16])
    assert [(one.object_id, one.label) for one in boxes] == [(11_004, label), (11_005, "dynamic")]


def test_what_moves_is_where_it_is_at_the_images_own_time() -> None:
    arrays = _arrays(_PINHOLE, _wall(_PINHOLE, 10.0)) | {
        "image_00_frame": np.array([4]), "image_00_time_s": np.array([0.44])
    }  # fmt: skip
    sooner, later, still = (
        _box(26_001, 10.0, 0.0, 2.0),
        _box(26_001, 10.0, 4.0, 2.0),
        _box(26_002, 10.0, 0.0, 6.0),
    )

    def boxes(time_s: float) -> list[BoxRecord]:
        return [sooner if time_s < 0.4 else later, still]

    found, table = instance_arrays(arrays, {"image_00": _PINHOLE}, boxes)
    shown = object_ids(found["image_00_instance"][0], table)
    columns = np.flatnonzero((shown == 26_001).any(axis=0))
    assert len(columns) and columns.min() > _PINHOLE.cx, "on the right, where it is by then"
