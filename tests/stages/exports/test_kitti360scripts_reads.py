"""The tree `kitti360` as kitti360Scripts itself reads it, where it is installed (it asks for much)."""

from pathlib import Path
from types import ModuleType

import matplotlib
import matplotlib.cm
import numpy as np
import pytest

from nvsf_core.geometry.se3 import transform_points
from nvsf_core.stages.exports.kitti360 import write_kitti360
from tests.stages.exports import small_data_set as small

ABSENT = "kitti360scripts is not here"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    # Release 1.0.0 is of 2022: numpy and matplotlib had these names then.
    monkeypatch.setattr(np, "int", int, raising=False)
    monkeypatch.setattr(matplotlib.cm, "get_cmap", matplotlib.colormaps.__getitem__, raising=False)
    return pytest.importorskip("kitti360scripts.helpers", reason=ABSENT)


@pytest.mark.usefixtures("scripts")
def test_a_point_of_the_world_is_seen_where_our_camera_sees_it(tmp_path: Path) -> None:
    project = pytest.importorskip("kitti360scripts.helpers.project", reason=ABSENT)
    data = small.data_set()
    write_kitti360(tmp_path, data)
    camera = project.CameraPerspective(str(tmp_path / "kitti360"), data.sequence, 0)
    assert (camera.width, camera.height) == (small.PINHOLE.width, small.PINHOLE.height)
    in_camera_m = np.array([[0.5, -0.3, 7.0], [-1.0, 0.4, 20.0]])
    for number, pose in zip(small.NUMBERS, small.POSES, strict=True):
        world_m = transform_points(pose @ small.IN_LIDAR, in_camera_m)
        (u, v), depth_m = camera.project_vertices(world_m, number)
        expected, _ = small.PINHOLE.project(in_camera_m)
        # It rounds to whole pixels.
        np.testing.assert_allclose(np.stack([u, v], axis=1), expected, atol=0.51)
        np.testing.assert_allclose(depth_m, in_camera_m[:, 2], atol=1e-4)


@pytest.mark.usefixtures("scripts")
def test_boxes_have_their_class_their_number_and_their_place(tmp_path: Path) -> None:
    annotation = pytest.importorskip("kitti360scripts.helpers.annotation", reason=ABSENT)
    data = small.data_set()
    write_kitti360(tmp_path, data)
    found = annotation.Annotation3D(str(tmp_path / "kitti360/data_3d_bboxes"), data.sequence)
    moving = found(26, 7, small.NUMBERS[1])
    assert moving.name == "car"
    np.testing.assert_allclose(moving.vertices.mean(axis=0), small.boxes(1)[0].box_to_world[:3, 3], atol=1e-3)
