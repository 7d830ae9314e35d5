"""A data set says what each format calls each camera, and which cameras it leaves out."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.drives.kitti360.calibration import read_calibration
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.view_entry import ViewEntry
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.recipe.presets import preset
from nvsf_core.stages.exports.card import card_of
from nvsf_core.stages.exports.kitti360 import kitti360_cameras, write_kitti360
from nvsf_core.stages.exports.of_view import RenderedView
from nvsf_core.stages.exports.records import CameraRecord
from nvsf_core.stages.exports.write import write_data_set
from nvsf_core.stages.runner.stage import RunConfig
from tests.stages.exports import small_data_set as small
from tests.stages.exports.test_card import _manifest, _written

COUNT = 2
RIG = small.rig(back=180.0, front=0.0, left=90.0, rear=170.0, right=-90.0)


def _view(cameras: dict[str, CameraRecord], *exports: str) -> RenderedView:
    """Two frames without a LiDAR; the last camera lacks the image of the second."""
    frames = np.arange(COUNT)
    arrays = {"frame": frames, "time_s": 0.1 * frames, "stamp_s": 0.1 * frames}
    arrays["lidar_to_world"] = small.POSES[:COUNT]
    for name, one in cameras.items():
        count = 1 if name == "right" else COUNT
        arrays[f"{name}_rgb"] = np.full((count, small.PINHOLE.height, small.PINHOLE.width, 3), 90, np.uint8)
        arrays[f"{name}_frame"], arrays[f"{name}_time_s"] = frames[:count], 0.1 * frames[:count]
        arrays[f"{name}_range_m"] = np.full(arrays[f"{name}_rgb"].shape[:3], 5.0, np.float16)
        arrays[f"{name}_camera_to_world"] = small.POSES[:count] @ one.in_lidar
    attrs = {
        "camera_models": {name: {"kind": "pinhole", **asdict(one.model)} for name, one in cameras.items()},
        "camera_in_lidar": {name: one.in_lidar.ravel().tolist() for name, one in cameras.items()},
        "sensor": "",
        "instances": [],
    }
    entry = ViewEntry(name="left", exports=("bin", *exports))
    return RenderedView(
        scene="s", sequence="2013_05_28_drive_0000_sync", entry=entry, arrays=arrays, attrs=attrs,
        config=RunConfig(recipe=preset("smoke")),
    )  # fmt: skip


def test_manifest_and_card_name_each_camera_of_each_format(tmp_path: Path) -> None:
    made = write_data_set(tmp_path, _view(RIG, "kitti", "kitti360", "nuscenes"), lambda time_s: [])
    without = {"right": None}
    assert made["camera_names"] == {
        "kitti": {**dict.fromkeys(RIG), "front": "image_2"},
        "kitti360": dict(
            zip(RIG, ("image_00", "image_01", "image_02", "image_03", None), strict=True)
        ),
        "nuscenes": {
            "back": "CAM_BACK", "front": "CAM_FRONT", "left": "CAM_LEFT", "rear": "CAM_REAR", **without,
        },
    }  # fmt: skip
    layout = DriveLayout(tmp_path / "kitti360", "2013_05_28_drive_0000_sync")
    assert all(layout.image_path(f"image_0{number}", 1).is_file() for number in range(4))
    card, text = _written(tmp_path, _manifest(camera_names=made["camera_names"]))
    assert card["what"]["camera_names"] == made["camera_names"]
    assert "In `kitti` camera `front` is `image_2`, `back` is left out" in text
    assert "`rear` is `image_03`, `right` is left out." in text


def test_cameras_that_keep_their_names_need_no_words(tmp_path: Path) -> None:
    made = write_data_set(tmp_path, _view(small.rig(image_00=0.0), "kitti360"), lambda time_s: [])
    assert made["camera_names"] == {"kitti360": {"image_00": "image_00"}}
    _, text = _written(tmp_path, _manifest(camera_names=made["camera_names"]))
    assert "is left out" not in text and " is `" not in text


@pytest.mark.parametrize(
    ("first", "places"),
    [
        ("front", ("image_00", "image_01", "image_02", "image_03", None)),
        ("image_00", ("image_00", "image_01", "image_02", "image_03", None)),
        ("image_02", ("image_02", "image_00", "image_03", "image_01", None)),
    ],
)
def test_a_fisheye_has_a_fisheyes_place_in_kitti360_and_comes_back(
    tmp_path: Path, first: str, places: tuple[str | None, ...]
) -> None:
    mei = MeiFisheye(1.2, 0.01, 1e-3, 5e-4, -5e-4, 60.0, 60.0, 31.0, 23.0, 64, 48)
    pinholes = small.rig(**{first: 0.0, "image_10": 15.0, "image_13": 30.0, "image_14": 40.0})
    flat = iter(pinholes.items())
    cameras = dict([next(flat), next(flat)])
    cameras["image_12"] = CameraRecord(model=mei, in_lidar=small.IN_LIDAR)
    cameras |= dict(flat)
    names = kitti360_cameras(cameras)
    assert tuple(names.get(name) for name in cameras) == places
    data = replace(small.data_set(), cameras=cameras)
    write_kitti360(tmp_path, data)
    layout = DriveLayout(tmp_path / "kitti360", data.sequence)
    assert layout.image_path(names["image_12"], small.NUMBERS[0]).is_file()
    calibration = read_calibration(layout, None, has_scans=True)
    found = calibration.cameras[names["image_12"]]
    assert found.intrinsics == mei
    in_lidar = invert_pose(calibration.lidar_to_pose) @ found.to_pose
    assert np.allclose(in_lidar, small.IN_LIDAR, atol=1e-9)


def test_a_joined_data_set_which_has_no_whole_formats_has_a_card() -> None:
    assert card_of(_manifest())["what"]["camera_names"] == {}


def test_a_bag_keeps_all_names_and_lacks_the_camera_that_lacks_an_image(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    made = write_data_set(tmp_path, _view(RIG, "mcap"), lambda time_s: [])
    assert made["camera_names"]["mcap"] == {**{name: name for name in RIG}, "right": None}
