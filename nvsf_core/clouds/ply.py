"""Writes point clouds with intensity as binary PLY, with numpy alone."""

from pathlib import Path

import numpy as np

from nvsf_core.clouds.binary_rows import write_rows


def write_ply(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) in metres and intensity (N,) in 0..1 as float32, in the given order.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points_m)}\n{properties}end_header\n"
    write_rows(path, header, points_m, intensity)
