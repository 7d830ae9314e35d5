"""Patches: small rectangles of a pano, whose neighbouring ranges are compared."""

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError


def uniform_corners(
    shape: tuple[int, int], patch: tuple[int, int], count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Rows (count,) and columns (count,) of the upper left corners of patches, of rows and columns.

    Uniform, with replacement, over all patches within the image, the last rows and columns included.

    Raises:
        ShapeError: The patch is larger than the image.
    """
    require_patch_fits(shape, patch)
    corners = (
        torch.randint(
            size - part + 1, (count,), generator=generator, device=generator.device, dtype=torch.int64
        )
        for size, part in zip(shape, patch, strict=True)
    )
    rows, columns = corners
    return rows, columns


def patch_pixels(
    corner_rows: Tensor, corner_columns: Tensor, patch: tuple[int, int], shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """All pixels, rows (p, h, w) and columns (p, h, w) int64, of patches (h, w) by upper left corners (p,).

    A corner too far down or right is moved until its patch lies within the image, as in the paper's code.
    (LiDAR4D's patches continue at the pano's other edge.)

    Raises:
        ShapeError: The patch is larger than the image.
    """
    require_patch_fits(shape, patch)
    down = torch.arange(patch[0], device=corner_rows.device)
    right = torch.arange(patch[1], device=corner_rows.device)
    rows = corner_rows.clamp(0, shape[0] - patch[0])[:, None, None] + down[:, None]
    columns = corner_columns.clamp(0, shape[1] - patch[1])[:, None, None] + right
    size = (len(corner_rows), *patch)
    return rows.expand(size), columns.expand(size)


def require_patch_fits(shape: tuple[int, int], patch: tuple[int, int]) -> None:
    """Refuse a patch that is larger than the image, or empty.

    Raises:
        ShapeError: It is.
    """
    if not (1 <= patch[0] <= shape[0] and 1 <= patch[1] <= shape[1]):
        raise ShapeError(f"expected patches of at least 1x1 within {shape}, found {patch}; use smaller ones")
