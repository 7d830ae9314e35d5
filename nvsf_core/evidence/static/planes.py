"""The planes that a cloud's points lie on, each with its nearest neighbours."""

import numpy as np
from scipy.spatial import cKDTree

PLANE_POINTS = 8
"""Neighbours, itself included, that tell a point's plane."""


def planes_around(point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How points (n, 3), n >= 8, scatter with their 8 nearest.

    Returns:
        Sums of squares (n, 3) along the principal axes, ascending; the first axis (n, 3), a unit normal.
    """
    _, near = cKDTree(point_m).query(point_m, PLANE_POINTS)
    apart = point_m[near] - point_m[near].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    return values, axes[:, :, 0]
