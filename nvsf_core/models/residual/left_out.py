"""A left-out training image for the camera networks to learn from."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nvsf_core.rendering.camera_view import CameraView


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A training image, and the view of it that is compared with, or rendered from, the other images."""

    view: CameraView
    """The inputs of the view, without the scan of its instant, and to draw it without the image itself."""
    truth: Tensor
    """(3, H, W) uint8."""
    small_truth: Tensor
    """(3, h, w) float32 in 0..1, at the size at which depth planes are compared."""
    coarse: Tensor | None = None
    """(3, h, w) of `coarse_colour`; None while images have no depths."""

    def to(self, device: torch.device) -> "LeftOut":
        """The same example on `device`."""
        truth, small = self.truth.to(device), self.small_truth.to(device)
        coarse = None if self.coarse is None else self.coarse.to(device)
        return LeftOut(self.view.to(device), truth, small, coarse)
