"""Ten million points at once, in chunks, with a plain oracle on a sample."""

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.numerics.cases.case import Case, Reading
from nvsf_core.evidence.static.voxels import index_points
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.sensors.beam_table import recorded_ray_of_points
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.tables import HDL_64E

TITLE = "Ten million points"
_POINTS, _CHUNK, _SAMPLE = 10_000_000, 1_000_000, 2_000


def _points(seed: int, count: int = _CHUNK) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 1.0, (count, 3)).astype(np.float32) * np.array([25.0, 25.0, 1.5], np.float32)


def _voxels() -> Reading:
    """All at once: every sampled point's voxel is the one that holds it, and voxels count all points."""
    points = np.concatenate([_points(seed) for seed in range(_POINTS // _CHUNK)])
    index, voxel = index_points(points, 0.2)
    sample = np.random.default_rng(0).integers(0, _POINTS, _SAMPLE)
    place = np.floor((points[sample].astype(np.float64) - index.origin_m) / index.voxel_m).astype(np.int64)
    brick = index.bricks[tuple((place // 8).T)]
    within = place % 8
    expected = index.cells[brick, within[:, 0] * 64 + within[:, 1] * 8 + within[:, 2]]
    wrong = int((expected != voxel[sample]).sum())
    everyone = int(np.bincount(voxel).sum()) == _POINTS and int(voxel.max()) + 1 == index.voxel_count
    return Reading(
        error=float(wrong), limit=0.0, unit="of 2,000 sampled", is_refuted=not everyone,
        outcome=f"{index.voxel_count:,} voxels; each point counted once: {everyone}",
    )  # fmt: skip


def _pano() -> Reading:
    """Projected in chunks and merged by the nearest, against one whole projection of a sample's cells."""
    pano, wrong = LinearPano(), 0
    nearest = np.full((pano.height, pano.width), np.inf, np.float32)
    kept_cells, kept_ranges = [], []
    for seed in range(_POINTS // _CHUNK):
        points = _points(seed)
        found, _ = pano.project(points, np.zeros(len(points), np.float32))
        nearest = np.minimum(nearest, np.where(found > 0.0, found, np.inf))
        row, column, range_m, kept = pano.cells(points)
        watched = kept & (column == 0)
        kept_cells.append(row[watched])
        kept_ranges.append(range_m[watched].astype(np.float32))
    rows, ranges = np.concatenate(kept_cells), np.concatenate(kept_ranges)
    for row in range(pano.height):
        mine = ranges[rows == row]
        wrong += int((float(mine.min()) if len(mine) else np.inf) != float(nearest[row, 0]))
    return Reading(
        error=float(wrong), limit=0.0, unit="cells of the seam's column",
        outcome=f"{int(np.isfinite(nearest).sum()):,} cells filled by {_POINTS:,} points",
    )  # fmt: skip


def _rays() -> Reading:
    """Origin + range x direction is the point, for ten chunks of a million."""
    worst = 0.0
    for seed in range(_POINTS // _CHUNK):
        points = _points(seed)
        laser = np.random.default_rng(seed).integers(-1, 64, len(points))
        origin, direction, range_m = recorded_ray_of_points(HDL_64E, points, laser)
        back = origin + direction * range_m[:, None]
        worst = max(worst, float(np.abs(back - points).max()))
    return Reading(error=worst, limit=1e-12, unit="m")


def _chamfer() -> Reading:
    """A million against a million, a sample's distances against all pairs."""
    truth, predicted = _points(0), _points(1)
    found = point_cloud_metrics(predicted[:200_000], truth)
    sample = np.random.default_rng(0).integers(0, 200_000, 50)
    tree = cKDTree(truth.astype(np.float64)).query(predicted[sample].astype(np.float64))[0]
    pairs = [np.sqrt(((truth.astype(np.float64) - p) ** 2).sum(axis=1).min()) for p in predicted[sample]]
    error = float(np.abs(tree - pairs).max())
    return Reading(error=error, limit=1e-12, unit="m", outcome=f"chamfer {found['chamfer_m2'].value:.4f} m²")


CASES = (
    Case("evidence.static.voxels.index_points", "1e7 points at once, 0.2 m voxels", _voxels),
    Case("sensors.linear_pano.LinearPano.project", "1e7 points in ten chunks", _pano),
    Case("sensors.beam_table.recorded_ray_of_points", "1e7 points in ten chunks", _rays),
    Case("metrics.point_cloud.point_cloud_metrics", "2e5 points against 1e6", _chamfer),
)
