"""What binary PLY and PCD have in common: a header in text, then x, y, z and intensity of each point."""

from pathlib import Path

import numpy as np

from nvsf_core.errors import ShapeError


def write_rows(path: Path, header: str, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write a header, then points (N, 3) in metres and intensity (N,) as float32 rows, in the given order.

    Raises:
        ShapeError: The arrays do not belong together.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3 or intensity.shape != points_m.shape[:1]:
        raise ShapeError(
            f"{path}: expected points (N, 3) and intensity (N,), found {points_m.shape} and {intensity.shape}"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + np.column_stack([points_m, intensity]).astype("<f4").tobytes())
