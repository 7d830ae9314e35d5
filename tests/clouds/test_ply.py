"""What is written as PLY and PCD comes back."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.clouds.ply import write_pcd, write_ply
from nvsf_core.drives.plain.clouds import read_pcd
from nvsf_core.errors import ShapeError
from tests.clouds.ply_reader import read_ply


def _cloud(count: int = 500) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(3)
    points_m = generator.normal(0.0, 20.0, (count, 3)).astype(np.float32)
    return points_m, generator.random(count).astype(np.float32)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_ply_returns_the_same_bits(tmp_path: Path, count: int) -> None:
    points_m, intensity = _cloud(count)
    write_ply(tmp_path / "a.ply", points_m, intensity)
    read_points_m, read_intensity = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(read_points_m, points_m)
    np.testing.assert_array_equal(read_intensity, intensity)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_pcd_returns_the_same_bits(tmp_path: Path, count: int) -> None:
    points_m, intensity = _cloud(count)
    write_pcd(tmp_path / "a.pcd", points_m, intensity)
    columns = read_pcd(tmp_path / "a.pcd", (tmp_path / "a.pcd").read_bytes())
    assert list(columns) == ["x", "y", "z", "intensity"]
    np.testing.assert_array_equal(np.stack([columns[name] for name in "xyz"], axis=1), points_m)
    np.testing.assert_array_equal(columns["intensity"], intensity)


@pytest.mark.parametrize("write", [write_ply, write_pcd])
def test_intensity_must_belong_to_the_points(tmp_path: Path, write: Callable) -> None:
    points_m, intensity = _cloud()
    with pytest.raises(ShapeError):
        write(tmp_path / "a", points_m, intensity[1:])


@pytest.mark.usefixtures("open3d")
def test_a_pcd_is_byte_for_byte_as_open3d_writes_it(tmp_path: Path) -> None:
    points_m, intensity = _cloud()
    write_pcd(tmp_path / "a.pcd", points_m, intensity)
    open3d = load_open3d()
    cloud = open3d.t.geometry.PointCloud(points_m)
    cloud.point["intensity"] = intensity[:, None]
    assert open3d.t.io.write_point_cloud(str(tmp_path / "b.pcd"), cloud)
    assert (tmp_path / "a.pcd").read_bytes() == (tmp_path / "b.pcd").read_bytes()


@pytest.mark.usefixtures("open3d")
def test_open3d_reads_our_ply_and_pcd(tmp_path: Path) -> None:
    points_m, intensity = _cloud()
    write_ply(tmp_path / "a.ply", points_m, intensity)
    write_pcd(tmp_path / "a.pcd", points_m, intensity)
    for name in ("a.ply", "a.pcd"):
        found = load_open3d().t.io.read_point_cloud(str(tmp_path / name)).point
        np.testing.assert_array_equal(found["positions"].numpy(), points_m)
        np.testing.assert_array_equal(found["intensity"].numpy().reshape(-1), intensity)
