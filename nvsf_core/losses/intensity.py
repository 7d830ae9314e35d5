"""How bright a return is."""

import torch
from torch import Tensor


def intensity_loss(intensity_logit: Tensor, true_intensity: Tensor) -> Tensor:
    """Squared error (r,) of intensities 0..1, of rays that returned."""
    return (torch.sigmoid(intensity_logit) - true_intensity) ** 2


def squared_intensity_error(intensity: Tensor, true_intensity: Tensor, is_return: Tensor) -> Tensor:
    """(I^ - I)^2 (r,) of rendered intensities 0..1, 0 where nothing returned.

    Eq. 7 of the paper (L_intensity), to be summed.

    Args:
        intensity: (r,) rendered.
        true_intensity: (r,) recorded.
        is_return: (r,) bool.
    """
    return ((intensity - true_intensity) * is_return) ** 2
