"""What is written as PLY comes back, and a broken file says so."""

from pathlib import Path

import numpy as np
import pytest

from nvsf_core.clouds.open3d_room import read_cloud, write_pcd
from nvsf_core.clouds.ply import read_ply, write_ply
from nvsf_core.errors import DataError, ShapeError


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


def test_ply_passes_over_other_properties(tmp_path: Path) -> None:
    vertex = np.dtype([("x", "<f8"), ("y", "<f8"), ("ring", "<u2"), ("z", "<f8"), ("intensity", "<f4")])
    rows = np.array([(1.0, 2.0, 7, 3.0, 0.5)], vertex)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment made by hand\nelement vertex 1\n"
        "property double x\nproperty double y\nproperty ushort ring\nproperty double z\n"
        "property float intensity\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    (tmp_path / "a.ply").write_bytes(header.encode() + rows.tobytes())
    points_m, intensity = read_ply(tmp_path / "a.ply")
    assert points_m.tolist() == [[1.0, 2.0, 3.0]]
    assert intensity.tolist() == [0.5]


def test_cut_off_ply_is_refused_by_name(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", *_cloud())
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content[:-5])
    with pytest.raises(DataError, match=r"a\.ply.*cut off"):
        read_ply(tmp_path / "a.ply")


def test_what_is_no_ply_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"solid cube")
    with pytest.raises(DataError, match="PLY header"):
        read_ply(tmp_path / "a.ply")


def test_intensity_must_belong_to_the_points(tmp_path: Path) -> None:
    points_m, intensity = _cloud()
    with pytest.raises(ShapeError):
        write_ply(tmp_path / "a.ply", points_m, intensity[1:])


@pytest.mark.usefixtures("open3d")
def test_open3d_reads_our_ply_and_its_own_pcd(tmp_path: Path) -> None:
    points_m, intensity = _cloud()
    write_ply(tmp_path / "a.ply", points_m, intensity)
    write_pcd(tmp_path / "a.pcd", points_m, intensity)
    for name in ("a.ply", "a.pcd"):
        read_points_m, read_intensity = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(read_points_m, points_m)
        np.testing.assert_array_equal(read_intensity, intensity)
