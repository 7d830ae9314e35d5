"""What a pixel shows."""

from torch import Tensor


def colour_loss(colour: Tensor, true_colour: Tensor) -> Tensor:
    """Squared error (r,), mean over channels, of colours (r, 3) in 0..1."""
    return ((colour - true_colour) ** 2).mean(dim=1)


def squared_colour_error(colour: Tensor, true_colour: Tensor) -> Tensor:
    """(C^ - C)^2 (r, 3) of colours (r, 3) in 0..1. Eq. 9 of the paper (L_rgb), to be summed."""
    return (colour - true_colour) ** 2
