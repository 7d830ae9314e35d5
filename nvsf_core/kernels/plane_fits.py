"""Planes through points by the covariances of these, in closed form; numba on the CPU.

A library's eigenvectors take ten times as long for matrices this small. One thread: to wake others takes
longer than the voxels of a moving object do.
"""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def fit_planes(covariance):  # type: ignore[no-untyped-def]
    """Spread across and along the planes that fit best, and their normals.

    The eigenvalues of a symmetric matrix A are q + 2 p cos(phi + 2 pi k / 3), where q is a third of its
    trace, 6 p^2 the sum of squares of A - q I, and cos(3 phi) half the determinant of (A - q I) / p (Smith
    1961). The normal is orthogonal to the rows of A less its least eigenvalue.

    Args:
        covariance: (v, 3, 3) float64, symmetric.

    Returns:
        least (v,) and middle (v,) eigenvalues, float64; unit normals (v, 3) float64, 0 where the points lie
        on a line, or at one place.
    """
    count = len(covariance)
    least, middle, normal = np.zeros(count), np.zeros(count), np.zeros((count, 3))
    for i in range(count):
        a = covariance[i]
        xy, xz, yz = a[0, 1], a[0, 2], a[1, 2]
        q = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
        x, y, z = a[0, 0] - q, a[1, 1] - q, a[2, 2] - q
        p = math.sqrt((x * x + y * y + z * z + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
        if p <= 0.0:
            least[i], middle[i] = q, q
            continue
        determinant = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
        cosine = determinant / (2.0 * p * p * p)
        phi = math.acos(min(1.0, max(-1.0, cosine))) / 3.0
        least[i] = q + 2.0 * p * math.cos(phi + 2.0 * math.pi / 3.0)
        middle[i] = q + 2.0 * p * math.cos(phi - 2.0 * math.pi / 3.0)
        x, y, z = a[0, 0] - least[i], a[1, 1] - least[i], a[2, 2] - least[i]
        _set_longest(
            normal[i], p * p,
            (xy * yz - xz * y, xz * xy - x * yz, x * y - xy * xy),
            (xy * z - xz * yz, xz * xz - x * z, x * yz - xy * xz),
            (y * z - yz * yz, yz * xz - xy * z, xy * yz - y * xz),
        )  # fmt: skip
    return least, middle, normal


@njit(inline="always")
def _set_longest(target, scale, first, second, third):  # type: ignore[no-untyped-def]
    """The longest of three vectors, which are parallel but for rounding, as a unit vector; 0 if all are 0."""
    best = 0.0
    for one in (first, second, third):
        square = one[0] * one[0] + one[1] * one[1] + one[2] * one[2]
        if square > best and square > 1e-20 * scale * scale:
            best = square
            length = math.sqrt(square)
            target[0], target[1], target[2] = one[0] / length, one[1] / length, one[2] / length
