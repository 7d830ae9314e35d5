"""Reads the PLY files that the project writes."""

from pathlib import Path

import numpy as np


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and intensity (N,) float32 of a binary PLY of four float properties."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[3:] == [f"property float {name}" for name in ("x", "y", "z", "intensity")]
    values = np.frombuffer(body, "<f4").reshape(int(lines[2].removeprefix("element vertex ")), 4)
    return values[:, :3], values[:, 3]
