"""The nuScenes export, read by a reader of its documented schema, and by the devkit where it is."""

import errno
import json
import resource
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nvsf_core.geometry.se3 import invert_pose, pose_from_parts, transform_points
from nvsf_core.stages.exports.nuscenes import LIDAR, TABLES, VERSION, nuscenes_channels, write_nuscenes
from nvsf_core.stages.exports.records import CameraRecord, ImageRecord
from tests.stages.exports import small_data_set as small

_LINKS = {
    "scene_token": "scene", "sample_token": "sample", "ego_pose_token": "ego_pose", "log_token": "log",
    "calibrated_sensor_token": "calibrated_sensor", "sensor_token": "sensor", "category_token": "category",
    "instance_token": "instance", "visibility_token": "visibility", "first_sample_token": "sample",
    "last_sample_token": "sample", "first_annotation_token": "sample_annotation",
    "last_annotation_token": "sample_annotation",
}  # fmt: skip
DEVKIT = "nuscenes-devkit is not here: it wants a numpy below 2 (decision 0023)"


def _pose(row: dict[str, Any]) -> np.ndarray:
    w, x, y, z = row["rotation"]
    return pose_from_parts(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(row["translation"]))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nuscenes")
    write_nuscenes(folder, small.data_set())
    return folder / "nuscenes"


@pytest.fixture(scope="module")
def tables(root: Path) -> dict[str, dict[str, dict[str, Any]]]:
    found = {name: json.loads((root / VERSION / f"{name}.json").read_text()) for name in TABLES}
    return {name: {row["token"]: row for row in rows} for name, rows in found.items()}


def test_every_link_leads_to_a_row_and_every_file_is_there(root: Path, tables: dict[str, Any]) -> None:
    for name, rows in tables.items():
        for row in rows.values():
            for key, table in _LINKS.items():
                assert key not in row or row[key] in tables[table], (name, key)
            for key in ("prev", "next"):
                other = row.get(key, "")
                back = "next" if key == "prev" else "prev"
                assert not other or rows[other][back] == row["token"], (name, key)
    data = list(tables["sample_data"].values())
    assert len(data) == 2 * small.COUNT and all((root / row["filename"]).is_file() for row in data)
    stamps = [row["timestamp"] for row in tables["sample"].values()]
    assert np.allclose(np.diff(stamps) / 1e6, np.diff(small.STAMPS))


def test_points_lie_in_the_world_where_they_were_and_have_ring_and_brightness(
    root: Path, tables: dict[str, Any]
) -> None:
    rows = [row for row in tables["sample_data"].values() if f"/{LIDAR}/" in row["filename"]]
    for index, row in enumerate(rows):
        points = np.fromfile(root / row["filename"], "<f4").reshape(-1, 5)
        scan = small.scan(index)
        ego = _pose(tables["ego_pose"][row["ego_pose_token"]])
        sensor = _pose(tables["calibrated_sensor"][row["calibrated_sensor_token"]])
        expected = transform_points(small.POSES[index], scan.rows[:, :3])
        assert np.allclose(transform_points(ego @ sensor, points[:, :3]), expected, atol=1e-4)
        assert np.allclose(points[:, 3], 255.0 * scan.rows[:, 3]) and (points[:, 4] == scan.ring).all()
        name = Path(row["filename"]).name.replace(".pcd.bin", ".bin")
        assert (np.fromfile(root / f"samples/{LIDAR}_time/{name}", "<f4") == scan.offset_s).all()
        assert (np.fromfile(root / f"samples/{LIDAR}_support/{name}", np.uint8) == scan.support).all()
    # nuScenes' LiDAR looks along y: what was ahead (x) has the largest y.
    ahead = small.scan(0).rows[:, 0].argmax()
    assert np.fromfile(root / rows[0]["filename"], "<f4").reshape(-1, 5)[:, 1].argmax() == ahead


def test_images_have_intrinsics_and_place(root: Path, tables: dict[str, Any]) -> None:
    rows = [row for row in tables["sample_data"].values() if "/CAM_FRONT/" in row["filename"]]
    for index, row in enumerate(rows):
        picture = cv2.imread(str(root / row["filename"]))[..., ::-1]
        assert (picture == small.image("image_00", index).rgb).all()
        calibrated = tables["calibrated_sensor"][row["calibrated_sensor_token"]]
        assert np.allclose(calibrated["camera_intrinsic"], small.PINHOLE.matrix)
        pose = _pose(tables["ego_pose"][row["ego_pose_token"]]) @ _pose(calibrated)
        assert np.allclose(pose, small.POSES[index] @ small.IN_LIDAR, atol=1e-6)


def test_each_camera_of_a_rig_has_a_channel_and_its_images(tmp_path: Path) -> None:
    level = dict.fromkeys(("back", "front"), 0.0)
    shades = {"back": 10, "front": 200}

    def shown(camera: str, index: int) -> ImageRecord:
        return replace(small.image(camera, index), rgb=np.full((48, 64, 3), shades[camera], np.uint8))

    write_nuscenes(tmp_path, replace(small.data_set(), cameras=small.rig(**level), image=shown))
    rows = json.loads((tmp_path / "nuscenes" / VERSION / "sample_data.json").read_text())
    assert len({row["token"] for row in rows}) == len(rows) == 3 * small.COUNT
    for channel, shade in (("CAM_BACK", 10), ("CAM_FRONT", 200)):
        files = sorted((tmp_path / "nuscenes/samples" / channel).glob("*.png"))
        assert [cv2.imread(str(one)).mean() for one in files] == [shade] * small.COUNT


@pytest.mark.parametrize(
    ("rig", "ahead"),
    [
        (small.rig(left=90.0, middle=-4.0, right=-90.0), "middle"),
        (small.rig(left_eye=0.3, right_eye=0.0, rear=180.0), "left_eye"),
        (small.rig(back=0.0, front=30.0), "front"),
        (small.rig(image_02=90.0, image_04=0.0), "image_02"),
        (small.rig(image_00=3.0, image_01=0.0), "image_00"),
    ],
    ids=["by its axis", "first of a pair", "by its name", "as KITTI has it", "first of KITTI's"],
)
def test_the_camera_that_looks_ahead_is_cam_front(rig: dict[str, CameraRecord], ahead: str) -> None:
    channels = nuscenes_channels(rig)
    assert channels[ahead] == "CAM_FRONT" and len(set(channels.values())) == len(rig)


def test_annotations_are_the_boxes_and_count_the_points_in_them(tables: dict[str, Any]) -> None:
    instances = tables["instance"].values()
    assert sorted(row["nbr_annotations"] for row in instances) == [small.COUNT, small.COUNT]
    assert {row["name"] for row in tables["category"].values()} == {"vehicle.car"}
    samples = list(tables["sample"])
    for row in tables["sample_annotation"].values():
        index = samples.index(row["sample_token"])
        pose, (width, length, height) = _pose(row), row["size"]
        assert np.allclose((width, length, height), (1.8, 4.0, 1.5))
        box = pose @ np.diag([length, width, height, 1.0])
        known = [one.box_to_world for one in small.boxes(index)]
        assert any(np.allclose(box, one, atol=1e-6) for one in known)
        local = transform_points(
            invert_pose(pose) @ small.POSES[index], small.scan(index).rows[:, :3]
        ) / [length, width, height]  # fmt: skip
        assert row["num_lidar_pts"] == int((np.abs(local) <= 0.5).all(axis=1).sum())


def test_a_box_whose_height_is_another_axis_stands_upright(tmp_path: Path) -> None:
    lying = np.zeros((4, 4))
    lying[0, 1], lying[1, 2], lying[2, 0], lying[3, 3] = 4.0, -1.8, -1.5, 1.0
    boxes = [replace(small.boxes(0)[0], box_to_world=lying)]
    write_nuscenes(tmp_path, replace(small.data_set(), boxes=lambda index: boxes))
    (row, *_) = json.loads((tmp_path / "nuscenes" / VERSION / "sample_annotation.json").read_text())
    assert np.allclose(row["size"], (1.8, 4.0, 1.5))
    rotation = _pose(row)[:3, :3]
    assert np.allclose(rotation[:, 2], (0.0, 0.0, 1.0)) and np.isclose(np.linalg.det(rotation), 1.0)


def test_the_devkit_reads_samples_points_and_boxes(root: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        devkit = pytest.importorskip("nuscenes.nuscenes", reason=DEVKIT)
        classes = pytest.importorskip("nuscenes.utils.data_classes", reason=DEVKIT)
        read = devkit.NuScenes(version=VERSION, dataroot=str(root), verbose=False)
    sample = read.sample[1]
    path, boxes, _ = read.get_sample_data(sample["data"][LIDAR])
    cloud = classes.LidarPointCloud.from_file(path)
    assert cloud.nbr_points() == small.POINTS
    expected = small.boxes(1)[0].box_to_world
    centre = transform_points(invert_pose(small.POSES[1]), expected[None, :3, 3])[0]
    assert any(np.allclose(box.center, (-centre[1], centre[0], centre[2]), atol=1e-3) for box in boxes)
    _, _, intrinsic = read.get_sample_data(sample["data"]["CAM_FRONT"])
    assert np.allclose(intrinsic, small.PINHOLE.matrix)


def test_what_stops_a_file_is_said(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError) as caught:
            write_nuscenes(tmp_path, small.data_set())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG, "as on a full disk: the message names it"
