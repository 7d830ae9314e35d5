"""Random variants of a left-out image for the camera networks: other colours, left and right exchanged."""

from dataclasses import dataclass

import torch
from torch import Tensor

_GAINS = (0.7, 1.3)
"""Range of the random factor on brightness."""


@dataclass(frozen=True, slots=True)
class Variation:
    """A variant of an example: the same change in all its images, so that depths and weights stay right."""

    channels: tuple[int, ...] = (0, 1, 2)
    """Which recorded channel each colour channel is."""
    gain: float = 1.0
    """Factor on brightness."""
    is_mirrored: bool = False
    """Whether networks see the mirrored scene."""

    def colours(self, recorded: Tensor) -> Tensor:
        """Colours (..., 3, h, w) in 0..1, from recorded ones."""
        if self.channels == (0, 1, 2) and self.gain == 1.0:
            return recorded
        order = torch.tensor(self.channels, device=recorded.device)
        return (recorded.index_select(-3, order) * self.gain).clamp_max(1.0)

    def turned(self, image: Tensor) -> Tensor:
        """An image (..., h, w) as networks see it, and, applied again, as it was."""
        return image.flip(-1) if self.is_mirrored else image


AS_RECORDED = Variation()


def random_variation(generator: torch.Generator) -> Variation:
    """Permuted colour channels, another brightness, and in half of the cases mirrored."""
    channels = torch.randperm(3, generator=generator)
    low, high = _GAINS
    gain = low + (high - low) * float(torch.rand((), generator=generator))
    is_mirrored = float(torch.rand((), generator=generator)) < 0.5
    return Variation(tuple(channels.tolist()), gain, is_mirrored)
