"""A left-out training image for the camera networks to learn from, and random variants of it."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nvsf_core.rendering.camera_view import CameraView, ShownImages

_GAINS = (0.7, 1.3)
"""Range of the random factor on brightness."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A training image, and the view of it that is compared with, or rendered from, the other images."""

    view: CameraView
    """The inputs of the view, without the scan of its instant, and to draw it without the image itself."""
    truth: Tensor
    """(3, H, W) uint8."""
    middle_truth: Tensor
    """(3, h, w) float32 in 0..1, at the size at which depths are refined."""
    small_truth: Tensor
    """(3, h, w) float32 in 0..1, at the size at which depth planes are compared."""

    def to(self, device: torch.device) -> "LeftOut":
        """The same example on `device`."""
        truths = (self.truth, self.middle_truth, self.small_truth)
        return LeftOut(self.view.to(device), *(truth.to(device) for truth in truths))

    def varied(self, generator: torch.Generator) -> "LeftOut":
        """A random variant: colour channels permuted, brightness scaled, and in half of the cases mirrored.

        All images of the example are changed alike, so depths and blending weights stay right.
        """
        channels = torch.randperm(3, generator=generator)
        gain = _GAINS[0] + (_GAINS[1] - _GAINS[0]) * float(torch.rand((), generator=generator))

        def lit(image: Tensor, most: float) -> Tensor:
            return (image[channels].float() * gain).clamp_max(most)

        def sources(images: Tensor) -> Tensor:
            other = torch.empty(len(self.view.chosen), *images.shape[1:], device=images.device)
            for place, number in zip(other, self.view.chosen, strict=True):
                place[3:] = images[number, 3:]
                for channel, source in enumerate(channels.tolist()):
                    torch.mul(images[number, source], gain, out=place[channel])
            if gain > 1.0:
                other[:, :3].clamp_max_(1.0)
            return other

        images = self.view.images
        seen = ShownImages(sources(images.full), sources(images.middle), sources(images.small))
        other = LeftOut(
            view=replace(self.view, images=seen, chosen=list(range(len(self.view.chosen)))),
            truth=lit(self.truth, 255.0).round().to(torch.uint8),
            middle_truth=lit(self.middle_truth, 1.0),
            small_truth=lit(self.small_truth, 1.0),
        )
        return other.mirrored() if float(torch.rand((), generator=generator)) < 0.5 else other

    def mirrored(self) -> "LeftOut":
        """The example with left and right exchanged."""
        return LeftOut(
            view=self.view.mirrored(),
            truth=self.truth.flip(-1),
            middle_truth=self.middle_truth.flip(-1),
            small_truth=self.small_truth.flip(-1),
        )
