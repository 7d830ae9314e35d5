"""Answers by evidence alone are those of the surfaces that it lists."""

import numpy as np

from nvsf_core.evidence.surfels import build_surfels, candidates_of, weighted_median_index
from nvsf_core.rendering.reproject import NEAR_M, reproject_rays


def test_a_ray_answers_with_the_median_surface_and_the_mean_intensity_of_its_candidates() -> None:
    generator = np.random.default_rng(0)
    direction = generator.normal(size=(20_000, 3)) * [1.0, 1.0, 0.2]
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    origin = generator.normal(0.0, 0.5, (20_000, 3)).astype(np.float32)
    range_m = generator.uniform(3.0, 6.0, 20_000).astype(np.float32)
    surfels = build_surfels(origin, direction, range_m, generator.uniform(0.0, 1.0, 20_000), voxel_m=0.2)
    rays = origin[:5000], direction[:5000].copy()
    rays[1][:100] = (0.0, 0.0, 1.0)  # nothing is up there
    hit_prior = generator.uniform(0.0, 1.0, 5000).astype(np.float32)
    rendered = reproject_rays(surfels, *rays, hit_prior, most=24, far_m=50.0)
    found = candidates_of(surfels, *rays, most=24, near_m=NEAR_M, far_m=50.0)
    weights = found.weights
    median = weighted_median_index(weights)
    there = found.voxel[:, 0] >= 0
    assert 0.9 < there.mean() < 1.0 and (median > 3).any()
    assert np.array_equal(rendered.range_m[there], found.range_m[np.arange(5000), median][there])
    mean = (weights * surfels.intensity[found.voxel]).sum(axis=1)[there] / weights.sum(axis=1)[there]
    assert np.abs(rendered.intensity[there] - mean).max() < 1e-6
    assert np.array_equal(rendered.hit, np.where(there, hit_prior, 0.0))
    assert np.isinf(rendered.range_m[~there]).all() and (rendered.intensity[~there] == 0.0).all()
