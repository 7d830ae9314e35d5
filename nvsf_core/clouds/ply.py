"""Writes point clouds with intensity as binary PLY, with numpy alone."""

from pathlib import Path

import numpy as np

from nvsf_core.errors import ShapeError


def write_ply(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) in metres and intensity (N,) in 0..1 as float32, in the given order.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3 or intensity.shape != points_m.shape[:1]:
        raise ShapeError(
            f"{path}: expected points (N, 3) and intensity (N,), found {points_m.shape} and {intensity.shape}"
        )
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points_m)}\n{properties}end_header\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + np.column_stack([points_m, intensity]).astype("<f4").tobytes())
