"""Loss of differences between neighbouring ranges: the shape of surfaces, not their distance.

Its masks say which pixels of a pano lie on smooth surfaces, where the loss applies; not across edges.
"""

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from nvsf_core.errors import RecipeError, ShapeError

BAND_EDGES_M = (0.0, 10.0, 20.0, 40.0, 80.0)
"""Borders of the distance bands of `mask_coverage`."""


def gradient_loss(
    rendered_range_m: Tensor,
    true_range_m: Tensor,
    mask_x: Tensor,
    mask_y: Tensor,
    norm: Literal["l1", "mse"] = "l1",
) -> Tensor:
    """M . |grad D^ - grad D| of each pixel, x and y added. Eq. 1 of the paper (L_grad), to be summed.

    grad D = D[i, j] - D[i, j + 1] along x, D[i, j] - D[i + 1, j] along y, signed. Each difference within a
    patch counts once, at its first pixel; the last column and row have none. (The authors repeat the last
    one, so that in patches of two rows each y difference counts twice.) At dropped rays the rendered range
    counts as 0, like the recorded one. The paper's equation has the absolute value, its text the square.

    Args:
        rendered_range_m: (p, h, w) rendered ranges of p patches.
        true_range_m: (p, h, w) recorded, 0 = no return.
        mask_x: (p, h, w) bool, where x gradients count; cut from the whole pano's `gradient_mask`.
        mask_y: (p, h, w) bool, the same for y.
        norm: "l1" = absolute difference, "mse" = squared.

    Returns:
        (p, h, w), metres (l1) or m2 (mse).

    Raises:
        ShapeError: The four differ in shape or are not patches.
    """
    shapes = {tuple(x.shape) for x in (rendered_range_m, true_range_m, mask_x, mask_y)}
    if len(shapes) != 1 or rendered_range_m.ndim != 3:
        raise ShapeError(f"gradient_loss: expected four times (p, h, w), found {sorted(shapes)}")
    # Differences are linear: the error of a difference is the difference of errors.
    error = rendered_range_m * (true_range_m > 0) - true_range_m
    along_x = pad(error[:, :, :-1] - error[:, :, 1:], (0, 1, 0, 0))
    along_y = pad(error[:, :-1] - error[:, 1:], (0, 0, 0, 1))
    if norm == "l1":
        return along_x.abs() * mask_x + along_y.abs() * mask_y
    return along_x**2 * mask_x + along_y**2 * mask_y


def gradient_mask(
    range_m: Tensor, kind: Literal["double", "single"], threshold_m: float
) -> tuple[Tensor, Tensor]:
    """Where surfaces are smooth, by g[k] = D[k] - D[k + 1]; a pixel without a return never passes.

    "single": the range hardly changes, |g| < tau. Source: LiDAR-NeRF, with tau = 0.01 m.

    "double": M^(2) of eq. 2 of the paper, the absolute gradient hardly changes, ||g|[k] - |g|[k + 1]| < tau.
    On a plane seen at a grazing angle the gradient is large, but its change is small: the pixel passes,
    where |g| < tau would fail. A single spike passes too: its two gradients differ in sign only.

    The last g of a row or column is repeated, and so is the last of its changes (as in the authors' code), so
    that the last two pixels of each always pass.

    Args:
        range_m: (..., H, W) recorded ranges, 0 = no return.
        kind: Which of the two.
        threshold_m: tau, above 0.

    Returns:
        Masks (..., H, W) bool for gradients along columns (x) and along rows (y). An axis of one pixel has no
        gradient: False throughout.

    Raises:
        RecipeError: The threshold is not above 0.
        ShapeError: Fewer than two axes.
    """
    if not threshold_m > 0.0:
        raise RecipeError(f"gradient mask: expected a threshold above 0 m, found {threshold_m}")
    if range_m.ndim < 2:
        raise ShapeError(f"gradient mask: expected (..., H, W), found {tuple(range_m.shape)}")
    gradients = _differences(range_m), _differences(range_m.transpose(-1, -2))
    changes = (_differences(g.abs()) if kind == "double" else g for g in gradients)
    along_x, along_y = (change.abs() < threshold_m for change in changes)
    return along_x & (range_m > 0), along_y.transpose(-1, -2) & (range_m > 0)


def mask_coverage(mask: Tensor, range_m: Tensor) -> list[tuple[int, int]]:
    """For each band of `BAND_EDGES_M`: the number of pixels with a return, and of those that the mask holds.

    Mask and ranges, 0 = no return, are (..., H, W).
    """
    hit = range_m > 0
    bands = [hit & (range_m >= low) & (range_m < high) for low, high in pairwise(BAND_EDGES_M)]
    return [(int(band.sum()), int((band & mask).sum())) for band in bands]


def _differences(values: Tensor) -> Tensor:
    """Each value minus the next along the last axis, the last one repeated; NaN if there is only one."""
    if values.shape[-1] == 1:
        return values * torch.nan
    found = values[..., :-1] - values[..., 1:]
    return torch.cat([found, found[..., -1:]], dim=-1)
