"""Loss of differences between neighbouring ranges: the shape of surfaces, not their distance."""

from typing import Literal

from torch import Tensor
from torch.nn.functional import pad

from nvsf_core.errors import ShapeError


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
