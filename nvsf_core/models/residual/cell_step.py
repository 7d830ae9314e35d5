"""One training step of a network over a turn's cells: those of the papers' pano, or the sensor's own."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.fields.cell_network import CellNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import LossWeights, TrainingSpec


@dataclass(frozen=True, slots=True)
class CellExample:
    """A training turn as the other scans lead to expect it, and as it was recorded."""

    features: Tensor
    """(features, h, w)."""
    hit_logit: Tensor
    """(h, w) of the expected hit."""
    intensity_logit: Tensor
    """(h, w) of the expected intensity."""
    weight: Tensor
    """(h, w): what a wrong hit costs; 0 where none can be expected."""
    returned: Tensor
    """(h, w) bool: whether it was recorded."""
    true_intensity: Tensor
    """(h, w)."""

    def columns(self, index: Tensor) -> "CellExample":
        """Some columns of it."""
        return CellExample(*(getattr(self, name)[..., index] for name in self.__slots__))


def cell_step(
    network: CellNetwork,
    examples: Sequence[CellExample],
    training: TrainingSpec,
    losses: LossWeights,
    generator: torch.Generator,
) -> LossBreakdown:
    """Correct a strip of a training turn, as high as it, and compare with what was recorded.

    hit: weighted cross-entropy; intensity, where the network has a second output: squared error where a
    return was expected and recorded.
    """
    example = examples[int(torch.randint(len(examples), (), generator=generator))]
    height, width = example.returned.shape
    margin = len(network.layers)
    inner = min(width, max(1, training.rays // height))
    first = int(torch.randint(width, (), generator=generator))
    strip = example.columns((torch.arange(-margin, inner + margin) + first) % width)
    correction = network(strip.features[None])[0]
    kept = slice(margin, margin + inner)
    weight, returned = strip.weight[:, kept], strip.returned[:, kept]
    there = weight > 0.0
    hit = (strip.hit_logit + correction[0])[:, kept]
    terms = {
        "hit": (weight * binary_cross_entropy_with_logits(hit, returned.float(), reduction="none"))[there]
    }
    if len(correction) > 1:
        both = there & returned
        brightness = torch.sigmoid(strip.intensity_logit + correction[1])[:, kept]
        terms["intensity"] = (brightness - strip.true_intensity[:, kept]).square()[both]
    return total_loss(terms, {"hit": losses.hit, "intensity": losses.intensity})
