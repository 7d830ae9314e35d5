"""Losses of images: colours of single pixels, and structure in small windows."""

from torch import Tensor
from torch.nn import functional

_WINDOW_PX, _STEP_PX = 7, 2
_LUMINANCE_FLOOR, _CONTRAST_FLOOR = 0.01**2, 0.03**2


def structure(shown: Tensor, truth: Tensor) -> Tensor:
    """1 - SSIM (Wang et al. 2004, eq. 13) of uniform 7x7 windows, every other pixel; mean of channels.

    Args:
        shown: (c, h, w) in 0..1, differentiable.
        truth: (c, h, w).

    Returns:
        (h', w') in 0..2, one for each window inside the image.
    """
    mean_x, mean_y = _mean(shown), _mean(truth)
    variance_x = _mean(shown.square()) - mean_x.square()
    variance_y = _mean(truth.square()) - mean_y.square()
    covariance = _mean(shown * truth) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + _LUMINANCE_FLOOR) / (
        mean_x.square() + mean_y.square() + _LUMINANCE_FLOOR
    )
    contrast = (2.0 * covariance + _CONTRAST_FLOOR) / (variance_x + variance_y + _CONTRAST_FLOOR)
    return (1.0 - luminance * contrast).mean(dim=0)


def _mean(image: Tensor) -> Tensor:
    return functional.avg_pool2d(image, _WINDOW_PX, _STEP_PX)


def squared_colour_error(colour: Tensor, true_colour: Tensor) -> Tensor:
    """(C^ - C)^2 (r, 3) of colours (r, 3) in 0..1. Eq. 9 of the paper (L_rgb), to be summed."""
    return (colour - true_colour) ** 2
