"""Laws of planes: a voxel whose returns are a line or too few takes the plane of the block around it."""

import numpy as np
import pytest

from nvsf_core.evidence.planes import fit_planes, moments_of
from nvsf_core.evidence.surfels import Surfels, build_surfels
from nvsf_core.evidence.voxels import index_points
from nvsf_core.rendering.reproject import reproject_rays

ABOVE_ROAD_M = 1.7
NOISE_M = 0.015


def rings(falls_rad: np.ndarray, advance_m: np.ndarray, seed: int) -> tuple[np.ndarray, ...]:
    """Rays of lasers that fall onto a road, each turned through 0.4 rad, from places along the way."""
    rng = np.random.default_rng(seed)
    azimuth = np.arange(-0.2, 0.2, 0.006)
    fall, turn, place = (part.ravel() for part in np.meshgrid(falls_rad, azimuth, advance_m, indexing="ij"))
    flat = np.cos(fall)
    direction = np.stack([flat * np.cos(turn), flat * np.sin(turn), -np.sin(fall)], axis=1)
    origin = np.stack([place, np.zeros_like(place), np.zeros_like(place)], axis=1)
    range_m = ABOVE_ROAD_M / np.sin(fall)
    noisy_m = range_m + rng.normal(0.0, NOISE_M, len(range_m))
    return origin.astype(np.float32), direction.astype(np.float32), noisy_m.astype(np.float32), range_m


@pytest.fixture(scope="module")
def crawling() -> Surfels:
    """A road as few lasers see it at walking pace: rings a step apart, none between."""
    origin, direction, noisy_m, _ = rings(np.deg2rad([8.0, 11.0, 15.0]), np.arange(10) * 0.13, 0)
    return build_surfels(origin, direction, noisy_m, np.full(len(noisy_m), 0.4), voxel_m=0.15, threads=1)


def test_a_road_of_single_rings_is_flat(crawling: Surfels) -> None:
    assert crawling.is_planar.mean() > 0.9
    assert np.median(np.abs(crawling.normal[crawling.is_planar, 2])) > 0.995


def test_rays_between_two_rings_end_on_the_road_and_not_above_it(crawling: Surfels) -> None:
    between = np.arange(9) * 0.13 + 0.065
    origin, direction, _, range_m = rings(np.deg2rad([8.0, 11.0, 15.0]), between, 1)
    vote = np.ones(len(origin), np.float32)
    found = reproject_rays(crawling, origin, direction, vote, most=24, far_m=80.0)
    off_m = found.range_m - range_m
    assert np.median(np.abs(off_m)) < 0.03
    assert (np.abs(off_m) > 0.22).mean() < 0.05


def test_leaves_are_hardly_ever_lent_a_plane() -> None:
    points = np.random.default_rng(2).uniform(0.0, 3.0, (3000, 3))
    index, voxel = index_points(points, 0.2)
    moments = moments_of(points, voxel, np.bincount(voxel))
    normal, _ = fit_planes(moments, index.origin_m, 0.2)
    # At its border the cube is cut into slabs, which are thin.
    inside = np.all((moments.mean_m > 0.6) & (moments.mean_m < 2.4), axis=1) & (moments.hits < 5)
    assert inside.sum() > 300
    assert normal.any(axis=1)[inside].mean() < 0.02


def test_what_stands_off_a_wall_is_not_lent_the_walls_plane() -> None:
    rng = np.random.default_rng(3)
    wall = np.stack([rng.normal(5.0, 0.002, 4000), rng.uniform(0, 4, 4000), rng.uniform(0, 4, 4000)], axis=1)
    wire = np.array([[5.32, 2.03, 2.05], [5.33, 2.04, 2.06]])
    points = np.concatenate([wall, wire])
    index, voxel = index_points(points, 0.2)
    moments = moments_of(points, voxel, np.bincount(voxel))
    normal, thickness = fit_planes(moments, index.origin_m, 0.2)
    assert not normal[voxel[-1]].any()
    assert np.abs(normal[voxel[:4000], 0]).min() > 0.99
    assert thickness[voxel[:4000]].max() < 0.02
