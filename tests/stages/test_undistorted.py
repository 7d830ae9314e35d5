import json
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.writer import flat_fisheye
from nvsf_core.errors import NvsfError
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.recipe.residual import ResidualRecipe
from nvsf_core.stages.flow import UNDISTORTED
from nvsf_core.stages.runner.stage import RunConfig, StageOutput, Task
from nvsf_core.stores.arrays import read_arrays, read_attrs
from nvsf_core.stores.scene_store import SceneStore
from nvsf_core.stores.tables import write_rows

PINHOLE = {"kind": "perspective", "width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 20.0}
FISHEYE = {
    "kind": "fisheye", "width": 60, "height": 60, "xi": 2.2, "k1": 0.017, "k2": 1.65, "p1": 4e-4, "p2": 4e-4,
    "gamma1": 57.0, "gamma2": 57.0, "u0": 30.0, "v0": 30.0,
}  # fmt: skip
COLUMNS = ("frame", "camera", "time_s", "camera_to_world", "image_valid", "reason", "checksum")
MOUNTING = np.eye(4).ravel().tolist()


def run(
    tmp_path: Path, cameras: dict[str, dict[str, float | str]], invalid: tuple[int, ...] = ()
) -> StageOutput:
    root, store = tmp_path / "drive", SceneStore(tmp_path / "home", "tiny")
    scene = SceneEntry(name="tiny", root=root, sequence="s", first_frame=5, last_frame=7, test_frames=())
    random, rows = np.random.default_rng(1), []
    for name, calibration in cameras.items():
        for frame in (7, 5, 6):
            path = DriveLayout(root, "s").image_path(name, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            shape = (int(calibration["height"]), int(calibration["width"]), 3)
            cv2.imwrite(str(path), random.integers(20, 255, shape, dtype=np.uint8))
            pose = np.eye(4)
            pose[0, 3] = 1000.0 + frame
            ok = frame not in invalid
            place = pose.ravel().tolist()
            rows.append(dict(zip(COLUMNS, (frame, name, 0.1 * frame, place, ok, "", ""), strict=True)))
    with store.publish("frames") as folder:
        mountings = dict.fromkeys(cameras, MOUNTING)
        (folder / "drive.json").write_text(json.dumps({"cameras": cameras, "camera_in_lidar": mountings}))
        write_rows(folder / "cameras.parquet", rows, COLUMNS)
    config = RunConfig(recipe=ResidualRecipe(name="quick"))
    with store.publish("undistorted") as folder:
        task = Task(scene=scene, store=store, config=config, folder=folder, progress=lambda _: None)
        return UNDISTORTED.run(task)


def images(tmp_path: Path) -> Path:
    return tmp_path / "home/tiny/undistorted/images.zarr"


def test_a_pinhole_in_a_fisheyes_place_keeps_its_images(tmp_path):
    """As `nvsf import` and our exports write a third pinhole into KITTI-360's layout."""
    flat = asdict(flat_fisheye(Pinhole(fx=70.0, fy=71.0, cx=40.0, cy=20.0, width=90, height=48)))
    run(tmp_path, {"image_02": flat | {"kind": "fisheye"}})
    facts = read_attrs(images(tmp_path))["cameras"]["image_02"]
    assert [facts[name] for name in ("fx", "fy", "cx", "cy", "width", "height")] == [70, 71, 40, 20, 90, 48]
    arrays = read_arrays(images(tmp_path), "image_02_rgb", "image_02_valid")
    assert arrays["image_02_valid"].all() and arrays["image_02_rgb"].min() >= 20


def test_a_perspective_camera_passes_through(tmp_path: Path) -> None:
    output = run(tmp_path, {"image_00": PINHOLE})
    arrays = read_arrays(images(tmp_path))
    source = cv2.imread(str(DriveLayout(tmp_path / "drive", "s").image_path("image_00", 5)))[..., ::-1]
    np.testing.assert_array_equal(arrays["image_00_rgb"][0], source)
    assert arrays["image_00_valid"].all()
    assert arrays["image_00_frame"].tolist() == [5, 6, 7]
    assert arrays["image_00_camera_to_world"][:, 0, 3].tolist() == [1005.0, 1006.0, 1007.0]
    assert read_attrs(images(tmp_path))["cameras"] == {"image_00": PINHOLE}
    assert all(check.passed for check in output.checks)
    preview = tmp_path / "home/tiny/undistorted" / output.previews["image_00"]
    assert 0 < preview.stat().st_size < 100_000


def test_a_fisheye_becomes_a_90_degree_view(tmp_path: Path) -> None:
    run(tmp_path, {"image_02": FISHEYE})
    facts = read_attrs(images(tmp_path))["cameras"]["image_02"]
    assert (facts["width"], facts["height"], facts["fx"]) == (60, 60, pytest.approx(30.0))
    assert facts["kind"] == "fisheye"
    arrays = read_arrays(images(tmp_path))
    assert arrays["image_02_rgb"].shape == (3, 60, 60, 3)
    assert arrays["image_02_valid"].any()


def test_an_invalid_image_is_left_out_and_counted(tmp_path: Path) -> None:
    output = run(tmp_path, {"image_00": PINHOLE}, invalid=(6,))
    assert read_arrays(images(tmp_path), "image_00_frame")["image_00_frame"].tolist() == [5, 7]
    assert output.metadata["images_left_out"] == 1


def test_a_drive_without_cameras_gives_an_empty_output(tmp_path: Path) -> None:
    output = run(tmp_path, {})
    assert read_attrs(images(tmp_path)) == {"cameras": {}, "camera_in_lidar": {}}
    assert read_arrays(images(tmp_path)) == {}
    assert output.metadata["cameras"] == 0


def test_a_camera_of_unknown_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NvsfError, match="perspective or fisheye"):
        run(tmp_path, {"image_00": {**PINHOLE, "kind": "equirectangular"}})
