"""Agreement of scans with rays, and voxels at places, against plain numpy."""

import numpy as np

from nvsf_core.geometry.voxels import index_points
from nvsf_core.kernels.ray_agreement import add_agreement, holds_points
from nvsf_core.kernels.scan_lookup import EMPTY, SAME, THROUGH

RAYS = 3000


def test_agreement_is_what_numpy_counts() -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(RAYS, 3)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    range_m = rng.uniform(1.0, 40.0, RAYS).astype(np.float32)
    range_m[::7] = np.inf
    has_end = np.isfinite(range_m)
    ends_m = direction * np.where(has_end, range_m, np.float32(60.0))[:, None]
    position_m = np.array([3.0, -1.0, 0.2])
    returned = has_end & (rng.random(RAYS) < 0.7)
    found = np.zeros((RAYS, 5), np.float32)
    found[np.arange(RAYS), rng.integers(0, 3, RAYS)] = 1.0
    found[rng.random(RAYS) < 0.2] = 0.0

    towards = ends_m - position_m
    distance_m = np.linalg.norm(towards, axis=1)
    cosine = (towards * direction).sum(axis=1) / distance_m
    ratio = distance_m / np.where(has_end, range_m, 1.0)
    alike = ~has_end | ((cosine >= np.cos(np.deg2rad(20.0))) & (ratio < 1.5) & (ratio > 1.0 / 1.5))
    same = np.where(returned, found[:, SAME], found[:, EMPTY])
    others = found[:, SAME] + found[:, THROUGH] + found[:, EMPTY] - same

    agreed, disagreed, looked = np.ones(RAYS, np.float32), np.zeros(RAYS, np.float32), np.zeros(RAYS, bool)
    add_agreement(ends_m, direction, range_m, returned, position_m, found, agreed, disagreed, looked)
    assert 0.1 < (same * alike).mean() < 0.9
    assert np.array_equal(agreed, 1.0 + same * alike)
    assert np.array_equal(disagreed, others)
    assert np.array_equal(looked, found.any(axis=1))


def test_a_place_is_held_by_the_voxel_of_a_return_alone() -> None:
    rng = np.random.default_rng(1)
    points_m = rng.uniform(-10.0, 10.0, (400, 3)).astype(np.float32)
    index, _ = index_points(points_m, 0.5)
    asked_m = np.concatenate([points_m, rng.uniform(-14.0, 14.0, (4000, 3)).astype(np.float32)])
    place = np.floor((asked_m - index.origin_m) / index.voxel_m).astype(np.int64)
    held = holds_points(asked_m, index, 0)
    assert held[:400].all() and not held.all()
    assert np.array_equal(held, index.find(place) >= 0)
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3)
    beside = np.any([index.find(place + step) >= 0 for step in around], axis=0)
    assert held.sum() < beside.sum() < len(beside)
    assert np.array_equal(holds_points(asked_m, index, 1), beside)
