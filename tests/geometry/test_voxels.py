"""The index of voxels: every point is found in its voxel, and bits and numbers tell of the same voxels."""

import numpy as np

from nvsf_core.geometry.voxels import BRICK, index_points, occupied_bits

POINTS_M = np.random.default_rng(2).normal(scale=(3.0, 2.0, 0.5), size=(3_000, 3)).astype(np.float32)


def test_every_point_is_found_in_the_voxel_that_it_was_numbered_with() -> None:
    index, voxel = index_points(POINTS_M, 0.2)
    place = np.floor((POINTS_M - index.origin_m) / index.voxel_m).astype(np.int64)
    assert (index.find(place) == voxel).mean() > 0.999, "float32 puts points on a border into either voxel"
    assert (index.find(index.places()) == np.arange(index.voxel_count)).all()


def test_a_voxel_has_a_bit_where_it_has_a_number() -> None:
    index, _ = index_points(POINTS_M, 0.2)
    assert index.occupied.shape == (len(index.cells), BRICK) and index.occupied.dtype == np.uint64
    assert (index.occupied == occupied_bits(index.cells)).all()
    for x in range(BRICK):
        for y in range(BRICK):
            for z in range(BRICK):
                bit = (index.occupied[:, x] >> np.uint64(BRICK * y + z)) & np.uint64(1)
                assert ((bit == 1) == (index.cells[:, (x * BRICK + y) * BRICK + z] >= 0)).all()
    assert int(np.bitwise_count(index.occupied).sum()) == index.voxel_count


def test_an_empty_brick_tells_in_how_large_an_empty_cube_it_lies() -> None:
    index, _ = index_points(np.random.default_rng(3).uniform(0.0, 100.0, (30, 3)), 0.5)
    marks = index.bricks
    assert len(np.unique(marks[marks < 0])) == 4, "single empty bricks, and cubes of 2, 4 and 8 an edge"
    for level in range(1, 4):
        edge = 1 << level
        for corner in np.ndindex(*(length // edge for length in marks.shape)):
            cube = marks[tuple(slice(edge * c, edge * (c + 1)) for c in corner)]
            assert ((cube <= -1 - level).all()) == ((cube < 0).all())
    place = np.argwhere(marks < 0) * BRICK
    assert (index.find(place) == -1).all()
