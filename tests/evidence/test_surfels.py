"""Laws of the voxel evidence, on a wall whose truth is known."""

import numpy as np
import pytest

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.evidence.surfels import build_surfels, candidates_of, weighted_median_index
from nvsf_core.geometry.voxels import index_points
from nvsf_core.kernels.voxel_passes import count_passes
from nvsf_core.rendering.reproject import reproject_rays

WALL_X_M = 10.03


def rays_to_wall(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays from near the origin to the plane x = 10.03, with the exact range."""
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-0.2, 0.2, (n, 3))
    target = np.stack([np.full(n, WALL_X_M), rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)], axis=1)
    ray = target - origin
    range_m = np.linalg.norm(ray, axis=1)
    return origin.astype(np.float32), (ray / range_m[:, None]).astype(np.float32), range_m.astype(np.float32)


@pytest.fixture(scope="module", params=[False, True], ids=["without shapes", "with shapes"])
def wall(request):
    rays = rays_to_wall(20_000, 0)
    return build_surfels(*rays, np.full(20_000, 0.4), voxel_m=0.2, has_shapes=request.param)


def test_every_point_lies_in_the_voxel_that_the_index_names() -> None:
    points = np.random.default_rng(1).uniform(-30, 30, (5000, 3))
    index, voxel = index_points(points, 0.5)
    ijk = np.floor((points - index.origin_m) / 0.5).astype(int)
    brick = index.bricks[tuple((ijk // 8).T)]
    within = ijk % 8
    assert (brick >= 0).all()
    assert (index.cells[brick, within[:, 0] * 64 + within[:, 1] * 8 + within[:, 2]] == voxel).all()
    assert index.voxel_count == len(np.unique(ijk, axis=0))


def test_no_points_are_an_error_that_says_what_to_look_at() -> None:
    with pytest.raises(DataError, match="found none"):
        index_points(np.zeros((0, 3)), 0.2)


def test_a_wall_becomes_planes_that_face_the_sensor(wall) -> None:
    planar = wall.is_planar
    assert planar.mean() > 0.95
    assert np.abs(wall.normal[planar, 0]).min() > 0.99
    assert np.allclose(wall.mean_m[:, 0], WALL_X_M, atol=1e-3)
    assert wall.hits.sum() == 20_000


def test_rays_beyond_a_surface_count_as_seen_through() -> None:
    origin = np.zeros((4, 3), np.float32)
    direction = np.tile(np.array([1, 0, 0], np.float32), (4, 1))
    surfels = build_surfels(
        origin, direction, np.array([5.1, 9.9, 9.9, 9.9], np.float32), np.zeros(4), voxel_m=0.2
    )
    near = int(np.argmin(np.abs(surfels.mean_m[:, 0] - 5.1)))
    far = int(np.argmin(np.abs(surfels.mean_m[:, 0] - 9.9)))
    assert surfels.passes[near] == 3
    assert surfels.passes[far] == 0


def rays_to_a_heap(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays from the origin to a heap of returns, of which no voxel is a plane, with the exact range."""
    point = np.random.default_rng(seed).normal(0.0, 0.3, (n, 3)) + np.array([6.0, 0.0, 0.0])
    range_m = np.linalg.norm(point, axis=1)
    ray = (point / range_m[:, None]).astype(np.float32)
    return np.zeros((n, 3), np.float32), ray, range_m.astype(np.float32)


@pytest.mark.parametrize("rays_to", [rays_to_wall, rays_to_a_heap])
def test_see_throughs_equal_a_walk_in_small_steps(rays_to) -> None:
    found = build_surfels(*rays_to(20_000, 0), np.full(20_000, 0.4), voxel_m=0.2, has_shapes=True)
    origin, direction, range_m = rays_to(300, 5)
    index = found.index
    rows, columns = np.triu_indices(3)
    precision = np.zeros((index.voxel_count, 3, 3))
    precision[:, rows, columns] = precision[:, columns, rows] = found.precision
    counted = np.zeros(index.voxel_count, int)
    for o, d, r in zip(origin.astype(float), direction.astype(float), range_m, strict=True):
        points = o + d * np.arange(0, r + 3.0, 0.002)[:, None]
        ijk = np.floor((points - index.origin_m) / index.voxel_m).astype(int)
        inside = ((ijk >= 0) & (ijk < np.array(index.bricks.shape) * 8)).all(axis=1)
        ijk, points = ijk[inside], points[inside]
        brick = index.bricks[tuple((ijk // 8).T)]
        within = ijk % 8
        cell = np.where(
            brick >= 0, index.cells[brick, within[:, 0] * 64 + within[:, 1] * 8 + within[:, 2]], -1
        )
        for crossed in np.unique(cell[cell >= 0]):
            off = points[cell == crossed] - found.mean_m[crossed]
            if found.is_planar[crossed]:
                off_m = np.abs(off @ found.normal[crossed])
                # Of a plane the extent is asked where the ray is nearest to it inside the voxel.
                off, near = off[[off_m.argmin()]], off_m.min() <= 0.01
            else:
                # Beyond the voxel, too: the line's closest place may lie just outside.
                off, near = off.mean(axis=0) + d * np.arange(-1.0, 1.0, 0.001)[:, None], True
            counted[crossed] += near and np.einsum("ni,ij,nj->n", off, precision[crossed], off).min() <= 6.25
    _, walked = count_passes(
        origin, direction, range_m + 3.0, index, found.mean_m, found.normal, found.precision
    )  # fmt: skip
    assert counted.sum() > 200
    # The stepped walk may miss a corner that it cuts by less than its step.
    assert np.abs(walked - counted).sum() <= 0.02 * counted.sum()


def rays_to_a_road() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays from 1.73 m above a road to 8 to 40 m along it, with ranges of 1 cm of noise."""
    rng = np.random.default_rng(3)
    place = np.stack([rng.uniform(8, 40, 60_000), rng.uniform(-3, 3, 60_000), np.zeros(60_000)], axis=1)
    origin = np.tile([0.0, 0.0, 1.73], (60_000, 1))
    range_m = np.linalg.norm(place - origin, axis=1)
    noisy_m = range_m + rng.normal(0.0, 0.01, 60_000)
    direction = (place - origin) / range_m[:, None]
    return origin.astype(np.float32), direction.astype(np.float32), noisy_m.astype(np.float32)


@pytest.mark.parametrize("shaped", [False, True])
def test_flat_rays_over_a_road_see_through_few_of_the_voxels_that_they_cross(shaped) -> None:
    rays = rays_to_a_road()
    road = build_surfels(*rays, np.zeros(60_000), voxel_m=0.2, has_shapes=shaped)
    crossed, _ = count_passes(*rays, road.index, road.mean_m, 0.0 * road.normal, np.zeros((0, 6), np.float32))
    # At 3 to 12 degrees a ray crosses up to several voxels of the road above it, before the one it ends in.
    assert crossed.sum() > 60_000
    assert road.passes.sum() < 0.1 * crossed.sum()


def test_flat_rays_end_on_a_road_and_not_above_it() -> None:
    rays = rays_to_a_road()
    learned, asked = slice(0, None, 2), slice(1, None, 2)
    road = build_surfels(*(column[learned] for column in rays), np.zeros(30_000), voxel_m=0.2)
    origin, direction, range_m = (column[asked] for column in rays)
    found = reproject_rays(road, origin, direction, np.ones(30_000, np.float32), most=24, far_m=60.0)
    error_m = found.range_m - range_m
    # A centimetre above the road is .2 m of range.
    assert abs(np.median(error_m)) < 0.02 and np.quantile(np.abs(error_m), 0.99) < 0.3


def test_surfels_without_shapes_are_the_same_together_and_alone() -> None:
    rng = np.random.default_rng(6)
    ray = rng.normal(size=(5_000, 3))
    ray = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)
    rays = (
        np.zeros_like(ray),
        ray,
        rng.uniform(0.05, 6.0, 5_000).astype(np.float32),
        rng.uniform(size=5_000),
    )
    is_surface = rng.uniform(size=5_000) < 0.9
    plain, shaped = (
        build_surfels(*rays, voxel_m=0.3, is_surface=is_surface, has_shapes=has) for has in (False, True)
    )
    own = ("precision", "passes")
    for name, expected in plain.to_arrays().items():
        if name not in own:
            np.testing.assert_array_equal(shaped.to_arrays()[name], expected, err_msg=name)
    assert len(plain.precision) == 0 and len(shaped.precision) == shaped.index.voxel_count
    assert (shaped.passes <= plain.passes).all() and (shaped.passes < plain.passes).any()


def test_a_ray_that_passes_a_pole_by_meets_what_is_behind_it() -> None:
    rng = np.random.default_rng(4)
    n = 2000
    pole = np.stack([np.full(n, 5.1), np.full(n, 0.02), rng.uniform(-0.5, 0.5, n)], axis=1)
    pole[:, :2] += rng.normal(0.0, 0.01, (n, 2))
    origin, direction, range_m = rays_to_wall(20_000, 0)
    off = np.abs(direction[:, 1] / direction[:, 0] * 5.1 + origin[:, 1] - 0.02)
    beside = off > 0.06
    along = np.linalg.norm(pole, axis=1)
    both = build_surfels(
        np.concatenate([np.zeros((n, 3), np.float32), origin[beside]]),
        np.concatenate([(pole / along[:, None]).astype(np.float32), direction[beside]]),
        np.concatenate([along.astype(np.float32), range_m[beside]]), np.zeros(n + int(beside.sum())),
        voxel_m=0.2, has_shapes=True,
    )  # fmt: skip
    asked = np.flatnonzero(beside & (off < 0.1))
    assert len(asked) > 100
    found = reproject_rays(
        both, origin[asked], direction[asked], np.ones(len(asked), np.float32), most=24, far_m=120.0
    )
    assert (np.abs(found.range_m - range_m[asked]) < 0.05).mean() > 0.9
    height_m = direction[:, 2] / direction[:, 0] * 5.1 + origin[:, 2]
    through = np.flatnonzero((off < 0.01) & (np.abs(height_m) < 0.4))
    assert len(through) > 30
    found = reproject_rays(
        both, origin[through], direction[through], np.ones(len(through), np.float32), most=24, far_m=120.0
    )
    assert (found.range_m < 5.5).mean() > 0.95


def test_the_reprojected_range_is_the_walls(wall) -> None:
    origin, direction, range_m = rays_to_wall(500, 7)
    rendered = reproject_rays(wall, origin, direction, np.ones(500, np.float32), most=24, far_m=120.0)
    assert np.median(np.abs(rendered.range_m - range_m)) < 1e-3
    assert (np.abs(rendered.range_m - range_m) < 0.05).mean() > 0.99
    assert np.allclose(rendered.intensity, 0.4, atol=1e-4)


def test_a_ray_that_meets_nothing_answers_nothing(wall) -> None:
    backwards = np.array([[-1.0, 0.0, 0.0]], np.float32)
    rendered = reproject_rays(
        wall, np.zeros((1, 3), np.float32), backwards, np.ones(1, np.float32), most=4, far_m=120.0
    )
    assert np.isinf(rendered.range_m[0])
    assert rendered.hit[0] == 0.0


def test_candidates_come_in_order_and_weights_never_exceed_one(wall) -> None:
    origin, direction, _ = rays_to_wall(200, 9)
    found = candidates_of(wall, origin, direction, most=8, near_m=0.5, far_m=100.0)
    there = found.voxel >= 0
    ascending = np.diff(np.where(there, found.range_m, 1e9), axis=1)
    assert (ascending[there[:, 1:]] >= -1e-5).all()
    weights = found.weights
    assert (weights.sum(axis=1) <= 1 + 1e-6).all()
    assert (weights[~there] == 0).all()


def test_the_median_is_the_first_sample_to_reach_half_of_the_weight():
    weights = np.array([[0.1, 0.3, 0.1, 0.1], [0.5, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0, 0.2], [0.0] * 4])
    assert weighted_median_index(weights.astype(np.float32)).tolist() == [1, 0, 3, 0]


def test_the_median_of_a_bimodal_ray_lies_on_a_surface():
    assert weighted_median_index(np.array([[0.45, 0.0, 0.0, 0.55]])).tolist() == [3]


@pytest.mark.parametrize("most", [0, -1])
def test_a_walk_without_room_for_a_surface_is_refused_before_its_kernel_writes(wall, most) -> None:
    origin, direction, _ = rays_to_wall(8, 1)
    with pytest.raises(ShapeError, match=f"at least 1 surface a ray, found {most}"):
        candidates_of(wall, origin, direction, most=most, near_m=0.0, far_m=50.0)
    with pytest.raises(ShapeError, match=f"at least 1 surface a ray, found {most}"):
        reproject_rays(wall, origin, direction, np.ones(8, np.float32), most=most, far_m=50.0)
