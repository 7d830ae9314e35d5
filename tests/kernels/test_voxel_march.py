"""Laws of the walk through a sparse voxel grid."""

from dataclasses import replace

import numpy as np
import pytest

from nvsf_core.evidence.surfels import Surfels, build_surfels
from nvsf_core.geometry.voxels import index_cells
from nvsf_core.kernels.voxel_march import PAST_M, WalkLimits, find_candidates

VOXEL_M = 0.5
NEAR_M, FAR_M = 0.9, 60.0


@pytest.fixture(scope="module", params=[False, True], ids=["without shapes", "with shapes"])
def sparse(request: pytest.FixtureRequest) -> Surfels:
    return thirty_heaps(has_shapes=request.param)


def thirty_heaps(*, has_shapes: bool) -> Surfels:
    """Surfels of thirty heaps of returns in a room of 40 m, most of whose bricks are empty."""
    generator = np.random.default_rng(0)
    points = np.repeat(heaps_m(), 200, axis=0) + generator.normal(0.0, 0.8, (6000, 3))
    range_m = np.linalg.norm(points, axis=1)
    direction = points / range_m[:, None]
    origin = np.zeros((6000, 3), np.float32)
    return build_surfels(
        origin, direction.astype(np.float32), range_m.astype(np.float32), np.full(6000, 0.4),
        voxel_m=VOXEL_M, has_shapes=has_shapes,
    )  # fmt: skip


def heaps_m() -> np.ndarray:
    return np.random.default_rng(2).uniform(-20.0, 20.0, (30, 3)) * [1.0, 1.0, 0.2]


def some_rays() -> tuple[np.ndarray, np.ndarray]:
    """Rays from inside and from outside, oblique, along axes, and away."""
    generator = np.random.default_rng(1)
    origin = generator.uniform(-30.0, 30.0, (400, 3)) * [1.0, 1.0, 0.2]
    direction = heaps_m()[generator.integers(0, 30, 400)] - origin
    direction[::8] *= -1.0
    direction[:60, generator.integers(0, 3)] = 0.0
    direction[:20] = np.eye(3)[generator.integers(0, 3, 20)] * generator.choice([-1.0, 1.0], (20, 1))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin.astype(np.float32), direction.astype(np.float32)


def crossed_m(surfels: Surfels, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where one ray enters and leaves every voxel (v,), near to far: by its slabs, without a walk."""
    index = surfels.index
    brick, within = np.nonzero(index.cells >= 0)
    corner = np.zeros((index.voxel_count, 3))
    place = np.argwhere(index.bricks >= 0)[np.argsort(index.bricks[index.bricks >= 0])][brick] * 8
    place = place + np.stack([within >> 6, (within >> 3) & 7, within & 7], axis=1)
    corner[index.cells[brick, within]] = index.origin_m + place * VOXEL_M
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (corner - origin.astype(np.float64)) / direction.astype(np.float64)
        b = (corner + VOXEL_M - origin.astype(np.float64)) / direction.astype(np.float64)
    enter = np.fmax.reduce(np.fmin(a, b), axis=1, initial=NEAR_M)
    leave = np.fmin.reduce(np.fmax(a, b), axis=1, initial=FAR_M)
    return enter, leave


def apart(surfels: Surfels, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """By how many standard deviations, squared (v,), one ray passes each voxel's returns; in float64."""
    rows, columns = np.triu_indices(3)
    precision = np.empty((surfels.index.voxel_count, 3, 3))
    precision[:, rows, columns] = precision[:, columns, rows] = surfels.precision
    mean, towards = surfels.mean_m - origin.astype(np.float64), direction.astype(np.float64)
    across = np.einsum("vij,j->vi", precision, towards)
    closest = np.einsum("vi,vi->v", across, mean) / (across @ towards)
    beside = mean - closest[:, None] * towards
    return np.einsum("vi,vij,vj->v", beside, precision, beside)


def test_a_voxel_of_several_cells_is_met_once_and_as_a_voxel_of_its_own_size() -> None:
    """Coarse voxels on a grid of fine cells against the same voxels on a grid of their own."""
    coarse = thirty_heaps(has_shapes=False)
    _, voxel, opacity, cosine, count = walked(coarse)
    place = coarse.index.places()
    for edge in (2, 4, 8):
        corners = np.stack(np.unravel_index(np.arange(edge**3), (edge,) * 3), axis=1)
        cells = (place[:, None] * edge + corners).reshape(-1, 3)
        fine, _ = index_cells(cells, coarse.index.origin_m, VOXEL_M / edge)
        brick = cells // 8
        within = cells % 8
        fine.cells[fine.bricks[tuple(brick.T)], within[:, 0] * 64 + within[:, 1] * 8 + within[:, 2]] = (
            np.repeat(np.arange(len(place)), edge**3)
        )
        found = walked(replace(coarse, index=fine._replace(edges=np.full(len(fine.cells), edge))))
        assert np.array_equal(found[4], count) and np.array_equal(found[1], voxel)
        assert found[2] == pytest.approx(opacity, abs=1e-4) and found[3] == pytest.approx(cosine, abs=1e-6)


def walked(surfels: Surfels, stop: float = 0.0, faintest: float = 0.0) -> tuple[np.ndarray, ...]:
    """Of `some_rays`: ranges, voxels, opacities, cosines and counts."""
    return find_candidates(
        *some_rays(), surfels.index, surfels.surfaces, WalkLimits(NEAR_M, FAR_M, 200, stop, faintest)
    )


def test_empty_cubes_are_crossed_as_their_bricks_are_one_by_one() -> None:
    points = heaps_m() * [1.0, 1.0, 5.0]
    range_m = np.linalg.norm(points, axis=1)
    direction = (points / range_m[:, None]).astype(np.float32)
    origin = np.zeros_like(direction)
    surfels = build_surfels(origin, direction, range_m.astype(np.float32), range_m * 0.0, voxel_m=0.2)
    bricks = surfels.index.bricks
    assert (bricks == -4).any()
    # From where the returns were recorded, and from beside it.
    rays = np.concatenate([origin, origin + np.float32(0.05)]), np.concatenate([direction, direction])
    limits = WalkLimits(NEAR_M, FAR_M, 200, 0.0, 0.0)
    one_by_one = surfels.index._replace(bricks=np.maximum(bricks, -1))
    found = find_candidates(*rays, surfels.index, surfels.surfaces, limits)
    expected = find_candidates(*rays, one_by_one, surfels.surfaces, limits)
    assert expected[4].sum() > 0
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, abs=1e-5)


def test_a_ray_meets_exactly_the_voxels_whose_slabs_it_crosses_in_their_order(sparse) -> None:
    origin, direction = some_rays()
    range_m, voxel, opacity, _, count = walked(sparse)
    assert count.max() > 10 and (count == 0).any()
    for ray in range(len(origin)):
        enter, leave = crossed_m(sparse, origin[ray], direction[ray])
        found = voxel[ray, : count[ray]]
        # A corner that is cut by less than a micrometre may be on either side of rounding.
        assert np.isin(np.flatnonzero(leave - enter > 1e-6), found).all()
        assert (leave[found] - enter[found] > -1e-6).all()
        assert (np.diff(enter[found]) > -1e-6).all() and len(np.unique(found)) == len(found)
        at_m, missed = (
            range_m[ray, : count[ray]],
            missed_by(sparse, origin[ray], direction[ray], found)[0] > 0,
        )
        margin_m = np.where(missed, PAST_M, 0.0) + 1e-5
        assert (np.diff(at_m) >= 0.0).all()
        # A plane that is met behind its voxel keeps those of the next voxels behind it.
        before_m = np.concatenate([[0.0], np.maximum.accumulate(leave[found] + margin_m)[:-1]])
        assert (at_m >= enter[found] - margin_m).all()
        assert (at_m <= np.maximum(leave[found] + margin_m, before_m)).all()
        assert (voxel[ray, count[ray] :] == -1).all() and (opacity[ray, count[ray] :] == 0.0).all()


def missed_by(
    surfels: Surfels, origin: np.ndarray, direction: np.ndarray, crossed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far a ray stays, inside each voxel that it crosses (c,), from its plane, metres; 0: it meets it.

    And how far from the mean along the plane, where it is nearest to it, in squared standard deviations.
    """
    ends_m = np.stack(crossed_m(surfels, origin, direction), axis=1)[crossed]
    places = ends_m[:, :1] + (ends_m[:, 1:] - ends_m[:, :1]) * np.linspace(0.0, 1.0, 4001)
    points = origin.astype(np.float64) + places[..., None] * direction.astype(np.float64)
    offset = points - surfels.mean_m[crossed, None]
    off_m = np.einsum("cea,ca->ce", offset, surfels.normal[crossed])
    is_met = off_m[:, 0] * off_m[:, -1] <= 0.0
    nearest = offset[np.arange(len(crossed)), np.abs(off_m).argmin(axis=1)]
    rows, columns = np.triu_indices(3)
    precision = np.zeros((len(crossed), 3, 3))
    if len(surfels.precision):
        precision[:, rows, columns] = precision[:, columns, rows] = surfels.precision[crossed]
    along = np.einsum("va,vab,vb->v", nearest, precision, nearest)
    return np.where(is_met, 0.0, np.abs(off_m[:, [0, -1]]).min(axis=1)), along


def test_a_plane_that_is_missed_by_little_is_met_where_it_goes_on() -> None:
    """Rays that graze a wall pass the corners of its voxels: where they stop, they stop on the wall."""
    generator = np.random.default_rng(5)
    along = generator.uniform(4.0, 12.0, 40_000)
    target = np.column_stack([along, np.full(40_000, 1.03), generator.uniform(-1.0, 1.0, 40_000)])
    range_m = np.linalg.norm(target, axis=1)
    direction = (target / range_m[:, None]).astype(np.float32)
    origin = np.zeros_like(direction)
    surfels = build_surfels(origin, direction, range_m.astype(np.float32), range_m * 0.0, voxel_m=VOXEL_M)
    limits = WalkLimits(NEAR_M, FAR_M, 8, 0.0, 0.0)
    at_m, _, opacity, _, count = find_candidates(origin, direction, surfels.index, surfels.surfaces, limits)
    # Missed by at most 7 mm, it goes on within 9 cm: the rays that graze it most do so by 5 degrees.
    stops = (opacity > 0.5) & (along[:, None] > 4.5) & (along[:, None] < 11.5)
    assert np.abs(at_m * direction[:, 1:2] - 1.03)[stops].max() < 1e-4
    assert stops.sum() > 1.01 * (count > 0).sum(), "some stop in two voxels"


def test_without_shapes_a_plane_that_is_missed_stops_less_and_other_returns_stop_anywhere() -> None:
    sparse = thirty_heaps(has_shapes=False)
    _, voxel, opacity, _, count = walked(sparse)
    origin, direction = some_rays()
    for ray in range(len(origin)):
        found = voxel[ray, : count[ray]]
        share = opacity[ray, : count[ray]] / sparse.opacity[found]
        off_m, _ = missed_by(sparse, origin[ray], direction[ray], found)
        assert share == pytest.approx(np.exp(-off_m / 0.01), rel=2e-3, abs=1e-6)
        assert (share[~sparse.is_planar[found]] == 1.0).all()


def test_opacity_falls_off_beside_a_plane_and_towards_the_ends_of_other_returns() -> None:
    sparse = thirty_heaps(has_shapes=True)
    _, voxel, opacity, _, count = walked(sparse)
    origin, direction = some_rays()
    missed = beside = beyond = 0
    for ray in range(len(origin)):
        found = voxel[ray, : count[ray]]
        share = opacity[ray, : count[ray]] / sparse.opacity[found]
        planar = sparse.is_planar[found]
        off = apart(sparse, origin[ray], direction[ray])[found]
        sure = ~planar & (np.abs(off - 6.25) > 1e-2)
        expected = np.where(off > 6.25, 0.03, np.exp(-0.1 * off))
        assert share[sure] == pytest.approx(expected[sure], rel=1e-3)
        off_m, along = missed_by(sparse, origin[ray], direction[ray], found)
        expected = np.exp(-off_m / 0.01) * np.where(along > 6.25, 0.5, 1.0)
        sure_of_planes = planar & (np.abs(along - 6.25) > 0.1)
        assert share[sure_of_planes] == pytest.approx(expected[sure_of_planes], rel=2e-3, abs=1e-6)
        beyond += int((off[sure] > 6.25).sum())
        missed += int((off_m[sure_of_planes] > 0.007).sum())
        beside += int((along[sure_of_planes] > 6.25).sum())
    assert min(missed, beyond) > 50 and beside > 10, (missed, beside, beyond)


def test_the_walk_ends_where_no_light_is_left(sparse) -> None:
    everything, lit = walked(sparse), walked(sparse, 0.3)
    before = np.cumprod(1.0 - everything[2].astype(np.float64), axis=1)
    ends = (before >= 0.3).sum(axis=1) + 1
    assert (lit[4] == np.minimum(ends, everything[4])).all()
    assert (lit[4] < everything[4]).any()


def test_surfaces_that_stop_hardly_any_light_are_left_out_and_nothing_else_changes(sparse) -> None:
    everything, bright = walked(sparse), walked(sparse, faintest=0.03)
    before = np.cumprod(1.0 - everything[2].astype(np.float64), axis=1) / (1.0 - everything[2])
    stopped = everything[2] * before
    sure = np.abs(stopped - 0.03) > 1e-5
    assert sure.mean() > 0.99
    for ray in np.flatnonzero(sure.all(axis=1)):
        kept = np.flatnonzero(stopped[ray] >= 0.03)
        assert bright[4][ray] == len(kept)
        for of_all, of_bright in zip(everything[:4], bright[:4], strict=True):
            assert (of_bright[ray, : len(kept)] == of_all[ray, kept]).all()
    assert 0 < bright[4].sum() < everything[4].sum()
