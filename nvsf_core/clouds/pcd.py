"""Writes point clouds with intensity as binary PCD, with numpy alone."""

from pathlib import Path

import numpy as np

from nvsf_core.clouds.binary_rows import write_rows


def write_pcd(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) in metres and intensity (N,) in 0..1 as float32, in the given order.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    count = len(points_m)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\n"
        f"TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\n"
        "DATA binary\n"
    )
    write_rows(path, header, points_m, intensity)
