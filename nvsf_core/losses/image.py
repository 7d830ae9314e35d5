"""Losses of images: colours of single pixels."""

from torch import Tensor


def squared_colour_error(colour: Tensor, true_colour: Tensor) -> Tensor:
    """(C^ - C)^2 (r, 3) of colours (r, 3) in 0..1. Eq. 9 of the paper (L_rgb), to be summed."""
    return (colour - true_colour) ** 2
