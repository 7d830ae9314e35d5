"""Planes of voxels: each voxel's own, or that of the blocks around it where its returns cannot tell."""

from dataclasses import dataclass

import numpy as np

MIN_PLANE_RETURNS = 5
PLANE_EIGENVALUE_RATIO = 4.0
_LINE_M = 0.03
"""Returns that spread less than this in the plane's second direction are one ring of one laser: its line
and the ranges' noise span a plane along the rays, which is none of the surface's."""
_BLOCK = 3
"""Voxels along the edge of a block, and blocks along the edge of the next coarser one."""
_COARSER_TIMES = 2
_MOST_THICKNESS_M = 0.05
"""Of a block's plane that is lent to its voxels."""
_LEAST_WIDTH = 0.15
"""Of the returns in a block, in its plane's second direction, in its edges."""
_OFF_M, _OFF_DEVIATIONS = 0.02, 2.0
"""How far a voxel's mean may lie off the plane that it is lent, in metres or in the plane's thickness."""


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Returns of v cells of one size."""

    hits: np.ndarray
    """(v,) number of returns, at least 1."""
    mean_m: np.ndarray
    """(v, 3) float64."""
    covariance_m2: np.ndarray
    """(v, 3, 3) float64 about the mean."""


def moments_of(points_m: np.ndarray, voxel: np.ndarray, hits: np.ndarray) -> Moments:
    """Moments of the points (n, 3) in each voxel (n,); `hits` (v,) says how many lie in each."""
    count = len(hits)
    total = [np.bincount(voxel, weights=points_m[:, a], minlength=count) for a in range(3)]
    mean = np.stack(total, axis=1) / hits[:, None]
    centred = points_m - mean[voxel]
    return Moments(hits, mean, _mean_products(voxel, hits, centred, np.ones(len(voxel)), None))


def fit_planes(voxels: Moments, low_m: np.ndarray, voxel_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Normals (v, 3) float32, 0 where there is no plane, and thickness (v,) float32 metres across it.

    A voxel's returns tell its plane if they are 5 or more, flat and no mere line. If they do not, the plane
    is lent by the block of 3 x 3 x 3 voxels around it, or else of 9 x 9 x 9, where one thin plane explains
    all returns of that block: a road that few lasers reach is flat all the same. Without it a voxel
    would stop rays that pass above its returns.

    Args:
        voxels: What lies in each voxel.
        low_m: (3,) lower corner of the grid.
        voxel_m: Edge of a voxel.
    """
    values, vectors = np.linalg.eigh(voxels.covariance_m2)
    planar = (voxels.hits >= MIN_PLANE_RETURNS) & (values[:, 1] > PLANE_EIGENVALUE_RATIO * values[:, 0])
    normal = np.where(planar[:, None], vectors[:, :, 0], 0.0)
    variance = values[:, 0].copy()
    asking = np.flatnonzero(~planar | (values[:, 1] < _LINE_M**2))
    cell = np.floor((voxels.mean_m - low_m) / voxel_m).astype(np.int64)
    blocks, block = voxels, np.arange(len(voxels.hits))
    for level in range(1, _COARSER_TIMES + 1):
        cell //= _BLOCK
        blocks, group = _joined(blocks, cell)
        cell, block = _first_of(group, cell), group[block]
        lent = _lent_normals(voxels, asking, blocks, block[asking], voxel_m * _BLOCK**level)
        given = lent.any(axis=1)
        normal[asking[given]] = lent[given]
        across = voxels.covariance_m2[asking[given]]
        variance[asking[given]] = np.einsum("vi,vij,vj->v", lent[given], across, lent[given])
        asking = asking[~given]
    return normal.astype(np.float32), np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)


def _lent_normals(
    voxels: Moments, asking: np.ndarray, blocks: Moments, block: np.ndarray, edge_m: float
) -> np.ndarray:
    """Normals (k, 3) that blocks (k,) lend the voxels `asking` (k,), 0 where one does not explain them."""
    values, vectors = np.linalg.eigh(blocks.covariance_m2)
    thickness, width = (np.sqrt(np.maximum(values[:, axis], 0.0)) for axis in (0, 1))
    lends = (blocks.hits >= MIN_PLANE_RETURNS) & (values[:, 1] > PLANE_EIGENVALUE_RATIO * values[:, 0])
    lends &= (thickness < _MOST_THICKNESS_M) & (width > _LEAST_WIDTH * edge_m)
    normal: np.ndarray = vectors[block, :, 0]
    off_m = np.abs(((voxels.mean_m[asking] - blocks.mean_m[block]) * normal).sum(axis=1))
    fits = lends[block] & (off_m < np.maximum(_OFF_M, _OFF_DEVIATIONS * thickness[block]))
    return np.where(fits[:, None], normal, 0.0)


def _joined(parts: Moments, cell: np.ndarray) -> tuple[Moments, np.ndarray]:
    """Moments of all parts (p,) that share a cell (p, 3), and the number (p,) of each part's."""
    _, group = np.unique(np.ravel_multi_index(cell.T, cell.max(axis=0) + 1), return_inverse=True)
    group = group.ravel()
    hits = np.bincount(group, weights=parts.hits)
    total = [np.bincount(group, weights=parts.hits * parts.mean_m[:, a]) for a in range(3)]
    mean = np.stack(total, axis=1) / hits[:, None]
    apart = parts.mean_m - mean[group]
    products = _mean_products(group, hits, apart, parts.hits, parts.covariance_m2)
    return Moments(hits, mean, products), group


def _mean_products(
    group: np.ndarray, total: np.ndarray, apart_m: np.ndarray, weight: np.ndarray, own_m2: np.ndarray | None
) -> np.ndarray:
    """(g, 3, 3) weighted mean over each group's rows of d d^T, and their own covariances where given."""
    products = np.empty((len(total), 3, 3))
    for a in range(3):
        for b in range(a, 3):
            row = apart_m[:, a] * apart_m[:, b]
            row = row if own_m2 is None else row + own_m2[:, a, b]
            sums = np.bincount(group, weights=weight * row, minlength=len(total))
            products[:, a, b] = products[:, b, a] = sums / total
    return products


def _first_of(group: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The cell (g, 3) that each group's rows share."""
    shared = np.empty((group.max() + 1, 3), cell.dtype)
    shared[group] = cell
    return shared
