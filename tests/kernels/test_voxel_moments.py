"""Moments of the points in voxels, against numpy's of each voxel by itself."""

import numpy as np
import pytest

from nvsf_core.kernels.voxel_moments import voxel_moments


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_mean_and_covariance_are_those_of_each_voxels_points(kind: type) -> None:
    generator = np.random.default_rng(0)
    voxel = generator.permutation(np.repeat(np.arange(40), np.arange(1, 41))).astype(np.int32)
    points_m = np.add(generator.normal(size=(len(voxel), 3)), [1e3, -2e3, 5.0]).astype(kind)
    mean, covariance = voxel_moments(points_m, voxel, np.bincount(voxel))
    for number in range(40):
        own = points_m[voxel == number].astype(np.float64)
        assert mean[number] == pytest.approx(own.mean(axis=0), rel=1e-12)
        assert covariance[number] == pytest.approx(np.cov(own.T, bias=True) if number else 0.0, abs=1e-12)
