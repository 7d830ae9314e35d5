"""One training step of a network over the cells of a pano or of the sensor's own grid."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.fields.layers import CellNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe.residual import LossWeights, TrainingSpec


@dataclass(frozen=True, slots=True)
class CellExample:
    """A training scan on a grid (h, w): what is expected from the other scans, and what was recorded."""

    features: Tensor
    """(features, h, w) float32: the network's input."""
    hit_logit: Tensor
    """(h, w) float32, of the expected hit probability."""
    intensity_logit: Tensor
    """(h, w) float32, of the expected intensity."""
    weight: Tensor
    """(h, w) float32: weight of a cell in the hit loss; 0 where no return can be expected."""
    returned: Tensor
    """(h, w) bool: whether a return was recorded."""
    true_intensity: Tensor
    """(h, w) float32 as recorded."""

    def to(self, device: torch.device) -> "CellExample":
        """The same example on `device`."""
        return CellExample(*(getattr(self, name).to(device) for name in self.__slots__))

    def columns(self, index: Tensor) -> "CellExample":
        """The columns `index` (k,) of all arrays."""
        return CellExample(*(getattr(self, name)[..., index] for name in self.__slots__))


def cell_step(
    network: CellNetwork,
    examples: Sequence[CellExample],
    training: TrainingSpec,
    losses: LossWeights,
    generator: torch.Generator,
) -> LossBreakdown:
    """The loss of a part of a step: a strip of columns of one training scan.

    Term `hit`: weighted cross-entropy. Term `intensity`, if the network has a second output: squared error
    where a return was both expected and recorded.

    Args:
        network: Adds to the logits of hit and intensity.
        examples: Of which one is sampled.
        training: Its `rays` is the number of cells in all strips of a step.
        losses: Weights of the terms.
        generator: Samples the example and the strip.
    """
    example = examples[int(torch.randint(len(examples), (), generator=generator))]
    height, width = example.returned.shape
    margin = len(network.layers)
    inner = min(width, max(1, training.rays // training.parts // height))
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
