"""How bright a return is."""

import torch
from torch import Tensor


def intensity_loss(intensity_logit: Tensor, true_intensity: Tensor) -> Tensor:
    """Squared error (r,) of intensities 0..1, of rays that returned."""
    return (torch.sigmoid(intensity_logit) - true_intensity) ** 2
