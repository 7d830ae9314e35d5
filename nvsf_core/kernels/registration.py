"""Generalised ICP with four parameters (yaw, x, y, z) for many small pairs of clouds at once, in numba.

After Segal, Haehnel and Thrun, "Generalized-ICP", RSS 2009: minimise sum e^T (C_q + R C_p R^T)^-1 e with
e = q - (R p + t), where a point's covariance C is 1 along its plane and 0.01 across it, or 0.1 all round
where it has no plane.
"""

import math

import numpy as np
from numba import njit, prange

_ACROSS = 0.01
_ROUND = 0.1
_STEPS = 8
_STILL_RAD = 1e-4
_STILL_M = 5e-4


@njit(inline="always")
def _add_covariance(total, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Add a point's covariance, by its normal (0 for none), to the six entries xx xy xz yy yz zz."""
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        total[0] += _ROUND
        total[3] += _ROUND
        total[5] += _ROUND
        return
    thin = 1.0 - _ACROSS
    total[0] += 1.0 - thin * nx * nx
    total[1] -= thin * nx * ny
    total[2] -= thin * nx * nz
    total[3] += 1.0 - thin * ny * ny
    total[4] -= thin * ny * nz
    total[5] += 1.0 - thin * nz * nz


@njit(inline="always")
def _invert(c, m):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric 3 x 3 matrix, six entries into six."""
    a = c[3] * c[5] - c[4] * c[4]
    b = c[2] * c[4] - c[1] * c[5]
    d = c[1] * c[4] - c[2] * c[3]
    determinant = c[0] * a + c[1] * b + c[2] * d
    m[0] = a / determinant
    m[1] = b / determinant
    m[2] = d / determinant
    m[3] = (c[0] * c[5] - c[2] * c[2]) / determinant
    m[4] = (c[1] * c[2] - c[0] * c[4]) / determinant
    m[5] = (c[0] * c[3] - c[1] * c[1]) / determinant


@njit(fastmath=True)
def _nearest(target, x, y, z, squares):  # type: ignore[no-untyped-def]
    """Index and squared distance of the nearest point of target (3, n) float32; squares (n,) is scratch."""
    least = np.float32(1e30)
    for i in range(target.shape[1]):
        dx = target[0, i] - x
        dy = target[1, i] - y
        dz = target[2, i] - z
        squares[i] = dx * dx + dy * dy + dz * dz
        least = min(least, squares[i])
    # Two plain loops run on vector units, one that keeps the index does not.
    for i in range(target.shape[1]):
        if squares[i] <= least:
            return i, least
    return 0, least


@njit
def _normal_equations(source, source_normal, target, target_normal, motion, gate_m, information, gradient):  # type: ignore[no-untyped-def]
    """Fill J^T M J (4, 4) and J^T M e (4,); returns inliers, sum of distances, sum of e^T M e."""
    cosine, sine = math.cos(motion[0]), math.sin(motion[0])
    information[:] = 0.0
    gradient[:] = 0.0
    covariance, m = np.zeros(6), np.zeros(6)
    squares = np.empty(target.shape[1], np.float32)
    inliers, distance, energy = 0, 0.0, 0.0
    for i in range(source.shape[1]):
        px, py, pz = source[0, i], source[1, i], source[2, i]
        x = cosine * px - sine * py + motion[1]
        y = sine * px + cosine * py + motion[2]
        z = pz + motion[3]
        k, square = _nearest(target, np.float32(x), np.float32(y), np.float32(z), squares)
        if square > gate_m * gate_m:
            continue
        ex, ey, ez = target[0, k] - x, target[1, k] - y, target[2, k] - z
        nx, ny, nz = source_normal[0, i], source_normal[1, i], source_normal[2, i]
        covariance[:] = 0.0
        _add_covariance(covariance, cosine * nx - sine * ny, sine * nx + cosine * ny, nz)
        _add_covariance(covariance, target_normal[0, k], target_normal[1, k], target_normal[2, k])
        _invert(covariance, m)
        mx = m[0] * ex + m[1] * ey + m[2] * ez
        my = m[1] * ex + m[3] * ey + m[4] * ez
        mz = m[2] * ex + m[4] * ey + m[5] * ez
        # d(R p)/d yaw.
        jx, jy = -sine * px - cosine * py, cosine * px - sine * py
        gradient[0] += jx * mx + jy * my
        gradient[1] += mx
        gradient[2] += my
        gradient[3] += mz
        ax, ay, az = m[0] * jx + m[1] * jy, m[1] * jx + m[3] * jy, m[2] * jx + m[4] * jy
        information[0, 0] += jx * ax + jy * ay
        information[0, 1] += ax
        information[0, 2] += ay
        information[0, 3] += az
        information[1, 1] += m[0]
        information[1, 2] += m[1]
        information[1, 3] += m[2]
        information[2, 2] += m[3]
        information[2, 3] += m[4]
        information[3, 3] += m[5]
        inliers += 1
        distance += math.sqrt(square)
        energy += ex * mx + ey * my + ez * mz
    for row in range(4):
        for column in range(row):
            information[row, column] = information[column, row]
    return inliers, distance, energy


@njit
def _solve(system, right):  # type: ignore[no-untyped-def]
    """Solve a positive definite system (n, n) by Cholesky's method; `right` (n,) becomes the solution.

    The system is overwritten. Numba's own solver takes 8 s to compile, more than all else in this file.
    """
    size = len(right)
    for row in range(size):
        for column in range(row + 1):
            value = system[row, column]
            for k in range(column):
                value -= system[row, k] * system[column, k]
            system[row, column] = math.sqrt(value) if row == column else value / system[column, column]
        for k in range(row):
            right[row] -= system[row, k] * right[k]
        right[row] /= system[row, row]
    for row in range(size - 1, -1, -1):
        for k in range(row + 1, size):
            right[row] -= system[k, row] * right[k]
        right[row] /= system[row, row]
    return right


@njit(parallel=True, cache=True, nogil=True)
def register_pairs(clouds, sources, targets, start, yaw_free, gates_m):  # type: ignore[no-untyped-def]
    """Register cloud `sources[i]` to cloud `targets[i]`, for all pairs i.

    Args:
        clouds: Points and normals (3, n) float32, each cloud about a centre of its own, and offsets (c + 1,):
            where each of the c clouds begins.
        sources: (pairs,) int64 clouds that are moved.
        targets: (pairs,) int64 clouds that they are moved onto.
        start: (pairs, 4) float64 first guess of yaw in radians and x, y, z in metres.
        yaw_free: (pairs,) bool: whether the yaw is estimated.
        gates_m: (g,) descending: how far apart partners may be.

    Returns:
        motion (pairs, 4): target = R(yaw) source + t; information (pairs, 4, 4) with unit noise; quality
        (pairs, 3): share of inliers, their mean distance in metres, their mean e^T M e.
    """
    points, normals, offsets = clouds
    count = len(sources)
    motions = start.copy()
    informations = np.zeros((count, 4, 4))
    quality = np.zeros((count, 3))
    for pair in prange(count):
        a, b = sources[pair], targets[pair]
        source = points[:, offsets[a] : offsets[a + 1]].copy()
        source_normal = normals[:, offsets[a] : offsets[a + 1]].copy()
        target = points[:, offsets[b] : offsets[b + 1]].copy()
        target_normal = normals[:, offsets[b] : offsets[b + 1]].copy()
        motion = motions[pair]
        information, gradient = informations[pair], np.zeros(4)
        inliers, distance, energy = 0, 0.0, 0.0
        for gate_m in gates_m:
            for _ in range(_STEPS):
                inliers, distance, energy = _normal_equations(
                    source, source_normal, target, target_normal, motion, gate_m, information, gradient
                )
                if inliers < 4:
                    break
                system = information.copy()
                # A hundredth of a point's weight keeps a single line of points solvable.
                for axis in range(4):
                    system[axis, axis] += 0.01
                if not yaw_free[pair]:
                    system[0, :] = 0.0
                    system[:, 0] = 0.0
                    system[0, 0] = 1.0
                    gradient[0] = 0.0
                step = _solve(system, gradient)
                motion += step
                if abs(step[0]) < _STILL_RAD and abs(step[1]) + abs(step[2]) + abs(step[3]) < _STILL_M:
                    break
        quality[pair, 0] = inliers / source.shape[1]
        quality[pair, 1] = distance / max(inliers, 1)
        quality[pair, 2] = energy / max(inliers, 1)
    return motions, informations, quality
