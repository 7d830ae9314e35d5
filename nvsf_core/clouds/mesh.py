"""A Poisson mesh of recorded points, and rays cast against a mesh; both by open3d."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.clouds.poisson import poisson_surface
from nvsf_core.errors import DataError

FEWEST_POINTS = 1000
"""From fewer points Poisson reconstruction makes no useful mesh."""
_NORMAL_NEIGHBOURS = 20

MeshRays = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From origins and unit directions (r, 3), metres: range_m (r,) float32, infinite where no triangle is
met, and intensity (r,) float32."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with an intensity at each corner."""

    vertices_m: np.ndarray
    """(v, 3) float32."""
    triangles: np.ndarray
    """(t, 3) int32, rows of `vertices_m`."""
    intensity: np.ndarray
    """(v,) float32, 0..1."""


def poisson_mesh(
    points_m: np.ndarray,
    towards_sensor: np.ndarray,
    intensity: np.ndarray,
    *,
    spacing_m: float,
    depth: int,
    trim_m: float,
) -> Mesh:
    """Screened Poisson reconstruction (Kazhdan and Hoppe 2013) of points, by open3d.

    Points are averaged in voxels of `spacing_m`, normals come from 20 neighbours and face the
    sensor. Poisson closes every hole; triangles with a corner farther than `trim_m` from all points
    are removed again. A corner has the intensity of its nearest point.

    Args:
        points_m: (n, 3) metres.
        towards_sensor: (n, 3) unit, from each point towards the sensor that measured it.
        intensity: (n,), 0..1.
        spacing_m: Edge of the voxels in which points are averaged.
        depth: Of the octree: a cell's edge is 1.1 times the cloud's longest side / 2^depth.
        trim_m: Farthest that a corner may lie from a point.

    Raises:
        MissingLibraryError: open3d cannot be loaded here.
        DataError: Fewer than `FEWEST_POINTS` points or no triangles are left, or open3d crashed.
    """
    open3d = load_open3d()
    vectors = open3d.utility.Vector3dVector
    cloud = open3d.geometry.PointCloud(vectors(points_m.astype(np.float64)))
    # Averaged with the points: the direction as a normal, the intensity as a colour.
    cloud.normals = vectors(towards_sensor.astype(np.float64))
    cloud.colors = vectors(np.repeat(intensity.astype(np.float64)[:, None], 3, axis=1))
    cloud = cloud.voxel_down_sample(spacing_m)
    if len(cloud.points) < FEWEST_POINTS:
        raise DataError(
            f"expected at least {FEWEST_POINTS} points {spacing_m} m apart for a mesh, found "
            f"{len(cloud.points)}; take more scans"
        )
    towards, shine = np.array(cloud.normals), np.asarray(cloud.colors)[:, 0]
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    away = np.einsum("ni,ni->n", normals, towards) < 0
    outward, points = np.where(away[:, None], -normals, normals), np.asarray(cloud.points)
    vertices, triangles = poisson_surface(points, outward, depth=depth)
    tree = cKDTree(points)
    distance_m, nearest = tree.query(vertices, distance_upper_bound=trim_m)
    kept = np.isfinite(distance_m)
    triangles = triangles[kept[triangles].all(axis=1)]
    if len(triangles) == 0:
        raise DataError(f"expected triangles within {trim_m} m of the points, found none; raise the depth")
    row = np.cumsum(kept) - 1
    return Mesh(
        vertices_m=vertices[kept].astype(np.float32),
        triangles=row[triangles].astype(np.int32),
        intensity=shine[nearest[kept]].astype(np.float32),
    )


def mesh_rays(mesh: Mesh) -> MeshRays:
    """Prepare a mesh for casting rays against it.

    Raises:
        MissingLibraryError: open3d cannot be loaded here.
    """
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        open3d.core.Tensor(np.ascontiguousarray(mesh.vertices_m, np.float32)),
        open3d.core.Tensor(np.ascontiguousarray(mesh.triangles, np.uint32)),
    )

    def cast(origin_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.concatenate([origin_m, direction], axis=1).astype(np.float32)
        found = scene.cast_rays(open3d.core.Tensor(rays))
        range_m = found["t_hit"].numpy()
        met = np.isfinite(range_m)
        corner = mesh.intensity[mesh.triangles[found["primitive_ids"].numpy()[met].astype(np.int64)]]
        u, v = found["primitive_uvs"].numpy()[met].T
        intensity = np.zeros(len(range_m), np.float32)
        intensity[met] = (1.0 - u - v) * corner[:, 0] + u * corner[:, 1] + v * corner[:, 2]
        return range_m, intensity

    return cast
