"""Screened Poisson reconstruction by open3d in a process of its own, which imports little else."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.errors import DataError

# More than one thread makes open3d's Poisson end the process now and then:
# https://github.com/isl-org/Open3D/issues/6828, https://github.com/mkazhdan/PoissonRecon/issues/136
_THREADS = 1
_SHOWN_CHARACTERS = 400


def poisson_surface(
    points_m: np.ndarray, normals: np.ndarray, *, depth: int
) -> tuple[np.ndarray, np.ndarray]:
    """Screened Poisson reconstruction in a process of its own, which may crash.

    Normals point out of the surface; `depth` is the octree's. Made are vertices (v, 3) float64 in metres and
    triangles (t, 3) int32, rows of the vertices.

    Raises:
        DataError: The process ended without a surface; says how.
    """
    with tempfile.TemporaryDirectory() as folder:
        cloud, surface = Path(folder) / "cloud.npz", Path(folder) / "surface.npz"
        np.savez(cloud, points_m=points_m, normals=normals)
        command = [sys.executable, "-m", "nvsf_core.clouds.poisson", str(cloud), str(depth), str(surface)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            said = done.stderr.strip()[-_SHOWN_CHARACTERS:]
            raise DataError(f"open3d's Poisson ended with exit code {done.returncode} and no surface: {said}")
        with np.load(surface, allow_pickle=False) as made:
            return made["vertices_m"], made["triangles"]


def _main(cloud_path: str, depth: str, surface_path: str) -> None:
    open3d = load_open3d()
    vectors = open3d.utility.Vector3dVector
    with np.load(cloud_path, allow_pickle=False) as given:
        cloud = open3d.geometry.PointCloud(vectors(given["points_m"]))
        cloud.normals = vectors(given["normals"])
    surface, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=int(depth), n_threads=_THREADS
    )
    np.savez(surface_path, vertices_m=np.asarray(surface.vertices), triangles=np.asarray(surface.triangles))


if __name__ == "__main__":
    _main(*sys.argv[1:])
