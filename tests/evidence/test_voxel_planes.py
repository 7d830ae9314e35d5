"""Planes of voxels: a wide surface makes them exact, and an edge leaves them alone."""

import numpy as np
import pytest

from nvsf_core.evidence.voxel_planes import VoxelPlanes, joined_planes, own_planes
from nvsf_core.geometry.voxels import VoxelIndex, index_points
from nvsf_core.kernels.voxel_moments import voxel_moments

VOXEL_M, NOISE_M, KERB_M, A_VOXEL = 0.2, 0.015, 0.12, 4


def planes_of(points_m: np.ndarray) -> tuple[VoxelIndex, VoxelPlanes, VoxelPlanes]:
    index, voxel = index_points(points_m, VOXEL_M)
    returns = np.bincount(voxel)
    mean_m, covariance = voxel_moments(points_m, voxel, returns)
    of_voxels = mean_m.astype(np.float32), covariance, returns
    return index, own_planes(*of_voxels), joined_planes(index, *of_voxels)


def road(length_m: float, normal: np.ndarray) -> np.ndarray:
    """Returns on a square through the origin, about `A_VOXEL` in each voxel, with noise across it."""
    rng = np.random.default_rng(5)
    count = round(A_VOXEL * (length_m / VOXEL_M) ** 2)
    flat = rng.uniform(-0.5 * length_m, 0.5 * length_m, (count, 3))
    flat -= (flat @ normal)[:, None] * normal
    return flat + rng.normal(0.0, NOISE_M, count)[:, None] * normal


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.6])
def test_a_wide_surface_s_planes_are_known_far_better_than_of_a_voxel_s_own_returns(tilt: float) -> None:
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    index, own, joined = planes_of(road(6.0, normal))

    def off_rad(planes: VoxelPlanes) -> np.ndarray:
        there = planes.normal.any(axis=1)
        return np.arccos(np.clip(np.abs(planes.normal[there] @ normal), 0.0, 1.0))

    assert joined.normal.any(axis=1).mean() > 0.9 > own.normal.any(axis=1).mean()
    assert np.median(off_rad(joined)) < 0.3 * np.median(off_rad(own))
    across_m = np.abs(joined.mean_m @ normal)
    assert np.median(across_m) < 0.6 * np.median(np.abs(own.mean_m @ normal))
    # A plane that left its voxel would be met by no ray.
    place = np.floor((joined.mean_m - index.origin_m) / VOXEL_M).astype(np.int64)
    assert np.array_equal(place, index.places())


def test_beside_a_kerb_most_planes_stay_those_of_the_voxel() -> None:
    flat, up = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, KERB_M])
    points_m = road(4.0, flat)
    points_m[points_m[:, 1] > 0.03] += up
    index, own, joined = planes_of(points_m)
    middle_m = index.origin_m + (index.places() + 0.5) * VOXEL_M
    beside = (np.abs(middle_m[:, 1] - 0.03) < VOXEL_M) & (np.abs(middle_m[:, 0]) < 1.7)
    assert beside.sum() > 40
    moved_m = np.abs(joined.mean_m[beside] - own.mean_m[beside]).max(axis=1)
    assert (moved_m == 0.0).mean() > 0.75
    # Of few returns some lie as on one slope.
    assert np.quantile(moved_m, 0.95) < 0.25 * KERB_M


def test_leaves_and_lone_voxels_have_no_plane() -> None:
    hedge_m = np.random.default_rng(5).uniform(-1.0, 1.0, (4000, 3))
    _, own, joined = planes_of(hedge_m)
    assert joined.normal.any(axis=1).mean() <= own.normal.any(axis=1).mean()
    _, _, lone = planes_of(np.arange(15.0).reshape(5, 3))
    assert not lone.normal.any()
