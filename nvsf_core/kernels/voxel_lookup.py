"""Which voxel stands at a place of the grid; numba, for other kernels."""

from numba import njit

from nvsf_core.kernels.voxel_march import BRICK


@njit(inline="always")
def number_at(x, y, z, bricks, cells):  # type: ignore[no-untyped-def]
    """Number of the voxel at grid coordinates, -1 where there is none.

    Args:
        x: Counted from the grid's lower corner, like the next two.
        y: Along the second axis.
        z: Along the third.
        bricks: As of `VoxelIndex`.
        cells: As of `VoxelIndex`.
    """
    if x < 0 or y < 0 or z < 0:
        return -1
    i, j, k = x // BRICK, y // BRICK, z // BRICK
    if i >= bricks.shape[0] or j >= bricks.shape[1] or k >= bricks.shape[2] or bricks[i, j, k] < 0:
        return -1
    return cells[bricks[i, j, k], (x % BRICK * BRICK + y % BRICK) * BRICK + z % BRICK]
