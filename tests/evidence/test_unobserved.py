"""Laws of unknown space, on a wall that is seen from one side and through a gap."""

import numpy as np
import pytest

from nvsf_core.evidence.surfels import Surfels, build_surfels, unobserved_beside
from nvsf_core.kernels.voxel_passes import count_passes

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
WALL_X_M, BEHIND_X_M, VOXEL_M = 10.1, 14.1, 0.2


@pytest.fixture(scope="module")
def rays() -> Rays:
    """At a wall 4 m wide, and through a gap of 1 m in it at another one 4 m behind."""
    random = np.random.default_rng(0)
    y, z = random.uniform(-2.0, 2.0, 60_000), random.uniform(-1.0, 1.0, 60_000)
    x = np.where(np.abs(y) < 0.5, BEHIND_X_M, WALL_X_M)
    target = np.column_stack([x, y * x / WALL_X_M, z * x / WALL_X_M])
    range_m = np.linalg.norm(target, axis=1)
    origin = np.zeros_like(target, np.float32)
    return origin, (target / range_m[:, None]).astype(np.float32), range_m.astype(np.float32)


@pytest.fixture(scope="module")
def proven(rays: Rays) -> Surfels:
    return build_surfels(*rays, np.where(rays[2] > 12.0, 0.9, 0.3), voxel_m=VOXEL_M)


@pytest.fixture(scope="module")
def unknown(proven: Surfels, rays: Rays) -> Surfels:
    found = unobserved_beside(proven, *rays)
    assert found is not None
    return found


def test_it_holds_no_return_shares_a_face_with_what_is_proven_and_no_ray_crossed_it(
    unknown: Surfels, proven: Surfels, rays: Rays
) -> None:
    place = np.rint((unknown.mean_m - proven.index.origin_m) / VOXEL_M - 0.5).astype(np.int64)
    assert np.abs(unknown.mean_m - (proven.index.origin_m + (place + 0.5) * VOXEL_M)).max() < 1e-4
    assert len(np.unique(place, axis=0)) == len(place)
    assert (proven.index.find(place) < 0).all()
    faces = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
    beside = np.stack([proven.index.find(place + face) for face in faces])
    assert (beside >= 0).any(axis=0).all()
    index = unknown.index
    passes, _ = count_passes(*rays, index, unknown.mean_m, unknown.normal, unknown.precision)
    assert passes.sum() == 0 and unknown.passes.sum() == 0 and unknown.hits.sum() == 0


def test_a_wall_has_it_behind_and_at_its_ends_not_before_it_and_not_in_a_gap_that_is_seen_through(
    unknown: Surfels,
) -> None:
    x, y, _ = unknown.mean_m.T
    assert (x > WALL_X_M - 0.5 * VOXEL_M).all(), "what lies before a surface is seen to be empty"
    of_wall = x < 12.0
    assert ((x > WALL_X_M + 0.5 * VOXEL_M) & of_wall).sum() > 100
    assert (np.abs(y[of_wall]) > 1.9).any()
    assert not (of_wall & (np.abs(y) < 0.4)).any()


def test_it_stops_half_of_the_light_and_shines_as_what_it_lies_beside(unknown: Surfels) -> None:
    assert np.allclose(unknown.opacity, 0.5)
    assert not unknown.is_planar.any()
    behind = unknown.mean_m[:, 0] > 12.0
    assert np.allclose(unknown.intensity[behind], 0.9) and np.allclose(unknown.intensity[~behind], 0.3)


def test_where_all_around_is_seen_nothing_is_unknown() -> None:
    around = np.stack(np.meshgrid(*3 * [np.linspace(-0.299, 0.299, 40)], indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    middle = np.array([[0.1, 0.1, 0.1]])
    origin = np.concatenate([around - np.array([3.0, 0.0, 0.0]), middle - np.array([3.0, 0.0, 0.0])])
    direction = np.tile(np.array([1.0, 0.0, 0.0]), (len(origin), 1))
    # All but the last look past the one return, and end 3 m behind it.
    range_m = np.append(np.full(len(around), 6.0), 3.0)
    is_surface = np.append(np.zeros(len(around), bool), True)
    lone = build_surfels(
        origin, direction, range_m, np.ones(len(origin)), voxel_m=VOXEL_M, is_surface=is_surface
    )
    rays = origin.astype(np.float32), direction.astype(np.float32), range_m.astype(np.float32)
    assert unobserved_beside(lone, *rays) is None
    kept = unobserved_beside(lone, *(column[-1:] for column in rays))
    assert kept is not None and len(kept.hits) == 5, "all faces but the one that the ray came through"


def test_places_and_numbers_of_voxels_find_each_other(proven: Surfels) -> None:
    index = proven.index
    place = index.places()
    assert np.array_equal(index.find(place), np.arange(index.voxel_count))
    inside = np.floor((proven.mean_m - index.origin_m) / VOXEL_M).astype(np.int64)
    assert (inside == place).all(axis=1).mean() > 0.99, "but for means on a border"
    outside = np.array([[-1, 0, 0], [0, 0, 8 * index.bricks.shape[2]], [10**6, 0, 0]])
    assert (index.find(outside) == -1).all()
