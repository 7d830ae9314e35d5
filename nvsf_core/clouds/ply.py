"""Writes point clouds with intensity as binary PLY or PCD, with numpy alone."""

from pathlib import Path

import numpy as np

from nvsf_core.errors import ShapeError


def write_ply(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) in metres and intensity (N,) in 0..1 as float32, in the given order.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points_m)}\n{properties}end_header\n"
    _write_rows(path, header, points_m, intensity)


def write_pcd(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write the same as PCD.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    count = len(points_m)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\n"
        f"TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\n"
        "DATA binary\n"
    )
    _write_rows(path, header, points_m, intensity)


def _write_rows(path: Path, header: str, points_m: np.ndarray, intensity: np.ndarray) -> None:
    if points_m.ndim != 2 or points_m.shape[1] != 3 or intensity.shape != points_m.shape[:1]:
        raise ShapeError(
            f"{path}: expected points (N, 3) and intensity (N,), found {points_m.shape} and {intensity.shape}"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + np.column_stack([points_m, intensity]).astype("<f4").tobytes())
