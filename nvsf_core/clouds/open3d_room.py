"""The one place where open3d is imported: lazily, because slim machines lack what it links to."""

import ctypes
import importlib
from pathlib import Path
from typing import Any

import numpy as np

from nvsf_core.errors import MissingLibraryError, StoreError

_LEAST_FACED = 0.02
"""Mean squared cosine between normals and a direction, below which ICP cannot tell a shift along it."""
_SYSTEM_PACKAGES = "libegl1 libgl1 libx11-6 libudev1 libidn2-0 libusb-1.0-0"


def load_open3d() -> Any:
    """The open3d module, with libusb loaded beforehand.

    Raises:
        MissingLibraryError: open3d or one of its system libraries is absent; the message names the packages.
    """
    _preload_libusb()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"not run: open3d cannot be loaded ({error}). `pip install open3d libusb-package` installs it,"
            f" `apt-get install -y {_SYSTEM_PACKAGES}` the system libraries that it links to"
        ) from error


def write_pcd(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) in metres and intensity (N,) in 0..1 as binary PCD.

    Raises:
        MissingLibraryError: open3d cannot be loaded here.
        StoreError: The file could not be written.
    """
    open3d = load_open3d()
    cloud = open3d.t.geometry.PointCloud(np.ascontiguousarray(points_m, np.float32))
    cloud.point["intensity"] = np.ascontiguousarray(intensity[:, None], np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not open3d.t.io.write_point_cloud(str(path), cloud):
        raise StoreError(f"{path}: open3d could not write the point cloud; is the disk full?")


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32 and intensity (N,) float32 of a .ply or .pcd, read by open3d.

    Raises:
        MissingLibraryError: open3d cannot be loaded here.
        StoreError: The file is absent or holds no point with intensity.
    """
    open3d = load_open3d()
    cloud = open3d.t.io.read_point_cloud(str(path))
    if "positions" not in cloud.point or "intensity" not in cloud.point:
        raise StoreError(f"{path}: expected points with intensity, open3d found {list(cloud.point)}")
    points_m = cloud.point["positions"].numpy().astype(np.float32)
    return points_m, cloud.point["intensity"].numpy().astype(np.float32).reshape(-1)


def registration_shift(
    source_m: np.ndarray, target_m: np.ndarray, max_distance_m: float = 0.5
) -> tuple[float, float, float]:
    """How far point-to-plane ICP moves a cloud that its poses had already laid over another.

    Args:
        source_m: (N, 3) points, in the same frame as `target_m`.
        target_m: (M, 3) points.
        max_distance_m: Pairs farther apart are not matched.

    Returns:
        Shift of the source's centroid in metres, turn in degrees, and the share of matched points. Along a
        direction that hardly any surface faces (a straight tunnel's) clouds slide freely: that part of the
        shift says nothing and is left out.

    Raises:
        MissingLibraryError: open3d cannot be loaded here.
    """
    open3d = load_open3d()
    registration = open3d.pipelines.registration
    centre = target_m.mean(axis=0, dtype=np.float64)
    source, target = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.astype(np.float64) - centre))
        for cloud in (source_m, target_m)
    )
    target.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=1.0, max_nn=30))
    result = registration.registration_icp(
        source, target, max_distance_m, np.eye(4), registration.TransformationEstimationPointToPlane()
    )
    moved = np.asarray(result.transformation)
    middle = np.append(source_m.mean(axis=0, dtype=np.float64) - centre, 1.0)
    shift_m = float(np.linalg.norm(_told(np.asarray(target.normals)) @ (moved @ middle - middle)[:3]))
    cosine = np.clip((np.trace(moved[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
    return shift_m, float(np.degrees(np.arccos(cosine))), float(result.fitness)


def _told(normals: np.ndarray) -> np.ndarray:
    """Projection (3, 3) onto the directions that surfaces with these normals (M, 3) face often enough."""
    share, axes = np.linalg.eigh(normals.T @ normals / len(normals))
    faced = axes[:, share > _LEAST_FACED]
    projection: np.ndarray = faced @ faced.T
    return projection


def _preload_libusb() -> None:
    """Make libusb's symbols known to the process: open3d's wheel links to it without bringing it."""
    try:
        library = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return  # the system may have it; if not, open3d's own import says so
    if library is not None:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
