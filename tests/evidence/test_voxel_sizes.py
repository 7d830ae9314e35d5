"""Laws of voxels of several sizes: fine where returns are dense, coarse where they are few and flat."""

import numpy as np
import pytest

from nvsf_core.evidence.surfels import StaticReturns, Surfels
from nvsf_core.evidence.voxel_sizes import VoxelMoments
from nvsf_core.geometry.voxels import index_points
from nvsf_core.kernels.voxel_moments import voxel_moments
from nvsf_core.rendering.reproject import reproject_rays

DENSE, SPARSE = 2000.0, 6.0
"""Returns a square metre."""


def plane_ahead(x_m: float, a_square_metre: float, rough_m: float = 0.0) -> np.ndarray:
    """Points on a wall of 6 x 4 m, or in front of it by up to `rough_m`."""
    rng = np.random.default_rng(3)
    count = round(24 * a_square_metre)
    points = rng.uniform([x_m, -3.0, -2.0], [x_m, 3.0, 2.0], (count, 3))
    points[:, 0] -= rng.uniform(0.0, rough_m, count) if rough_m else rng.normal(0.0, 0.005, count)
    return points


def static(points: np.ndarray) -> StaticReturns:
    """Returns at these points of rays that start at the origin."""
    range_m = np.linalg.norm(points, axis=1)
    direction = (points / range_m[:, None]).astype(np.float32)
    return StaticReturns.of(
        0.0 * direction, direction, range_m.astype(np.float32), np.full(len(points), 0.5, np.float32),
        np.ones(len(points), bool),
    )  # fmt: skip


def edges_at(surfels: Surfels, points: np.ndarray) -> np.ndarray:
    """Edges, metres, of the voxels in which points lie."""
    place = np.floor((points - surfels.index.origin_m) / surfels.index.voxel_m).astype(np.int64)
    return surfels.index.voxel_m * surfels.index.edges_of(place)


def test_dense_returns_get_fine_voxels_and_sparse_flat_ones_coarse_ones() -> None:
    near, far, leaves = (
        plane_ahead(8.0, DENSE), plane_ahead(30.0, SPARSE), plane_ahead(50.0, SPARSE, rough_m=2.0)
    )  # fmt: skip
    shown = static(np.concatenate([near, far, leaves])).shown(0.8)
    assert np.median(edges_at(shown, near)) == pytest.approx(0.1)
    assert np.median(edges_at(shown, far)) == pytest.approx(0.8)
    assert (edges_at(shown, leaves) < 0.3).mean() > 0.95, "what is no plane has edges to lose"
    assert int(shown.hits.sum()) == len(near) + len(far) + len(leaves)


def test_no_voxel_is_coarser_than_asked_and_a_field_s_are_never_finer_than_20_cm() -> None:
    returns = static(np.concatenate([plane_ahead(8.0, DENSE), plane_ahead(30.0, SPARSE)]))
    for coarsest_m in (0.2, 0.4, 0.8):
        for surfels in (returns.shown(coarsest_m), returns.field(coarsest_m)):
            assert surfels.index.voxel_m * surfels.index.edges.max() == pytest.approx(coarsest_m)
        assert returns.field(coarsest_m).index.voxel_m == pytest.approx(0.2)


def test_all_cells_of_a_voxel_have_its_number_and_its_returns_lie_in_them() -> None:
    points = np.concatenate([plane_ahead(8.0, DENSE), plane_ahead(30.0, SPARSE)])
    shown = static(points).shown(0.8)
    index = shown.index
    place, number = index.occupied_cells()
    edges = index.edges_of(index.places())
    assert np.array_equal(np.bincount(number), edges**3)
    low, high = index.places()[number], index.places()[number] + edges[number][:, None]
    assert ((place >= low) & (place < high)).all()
    assert np.array_equal(index.find(place), number)
    found = index.find(np.floor((points - index.origin_m) / index.voxel_m).astype(np.int64))
    off = np.abs(np.bincount(found, minlength=len(shown.hits)) - shown.hits).sum()
    assert off < 0.001 * len(points), "float32 puts points on a border into either voxel"


def test_a_sparse_wall_has_no_gaps_in_coarse_voxels() -> None:
    returns = static(plane_ahead(30.0, SPARSE))
    rng = np.random.default_rng(5)
    aim = rng.uniform([30.0, -2.5, -1.5], [30.0, 2.5, 1.5], (2000, 3))
    direction = (aim / np.linalg.norm(aim, axis=1, keepdims=True)).astype(np.float32)
    ones = np.ones(len(aim), np.float32)

    def met(coarsest_m: float) -> np.ndarray:
        found = reproject_rays(
            returns.shown(coarsest_m), 0.0 * direction, direction, ones, most=24, far_m=80.0
        )
        return found.range_m * direction[:, 0]

    assert np.isfinite(met(0.2)).mean() < 0.5
    assert np.isfinite(met(0.8)).all()
    assert np.median(np.abs(met(0.8) - 30.0)) < 0.005


def test_moments_of_merged_voxels_are_those_of_their_points() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-2.0, 2.0, (3000, 3))
    _, voxel = index_points(points, 0.1)
    returns = np.bincount(voxel)
    mean, covariance = voxel_moments(points, voxel, returns)
    fine = VoxelMoments(mean.astype(np.float32), covariance, returns, np.full(len(returns), 0.5, np.float32))
    into = rng.integers(0, 40, len(returns))
    merged = fine.merged(into)
    expected = voxel_moments(points, into[voxel], np.bincount(into[voxel]))
    np.testing.assert_allclose(merged.mean_m, expected[0], atol=1e-6)
    np.testing.assert_allclose(merged.covariance, expected[1], atol=1e-6)
    assert merged.returns.sum() == 3000 and merged.intensity == pytest.approx(0.5)


def test_a_scene_too_large_for_the_finest_voxels_has_a_field_s() -> None:
    corners = np.array([[10.0, 0.0, 0.0], [3000.0, 3000.0, 0.0], [10.0, 1.0, 60.0]])
    assert static(corners).shown(0.8).index.voxel_m == pytest.approx(0.2)
    assert static(corners[[0, 2]]).shown(0.8).index.voxel_m == pytest.approx(0.1)
