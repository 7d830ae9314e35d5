"""One training step of the network over a pano's cells."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.fields.pano_network import PanoNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import LossWeights, PanoSpec

_TYPICAL_RANGE_M = 20.0
"""A cell of this range counts once."""


@dataclass(frozen=True, slots=True)
class PanoExample:
    """A training pano as the other scans lead to expect it, and as it was recorded."""

    features: Tensor
    """(FEATURES, h, w)."""
    hit_logit: Tensor
    """(h, w) of the expected hit."""
    intensity_logit: Tensor
    """(h, w) of the expected intensity."""
    range_m: Tensor
    """(h, w) expected, 0 where no ray falls."""
    true_range_m: Tensor
    """(h, w), 0 = empty."""
    true_intensity: Tensor
    """(h, w)."""

    def columns(self, index: Tensor) -> "PanoExample":
        """Some columns of it."""
        return PanoExample(*(getattr(self, name)[..., index] for name in self.__slots__))


def pano_step(
    network: PanoNetwork,
    examples: Sequence[PanoExample],
    spec: PanoSpec,
    losses: LossWeights,
    generator: torch.Generator,
) -> LossBreakdown:
    """Correct a strip of a training pano, as high as it, and compare with what was recorded.

    hit: cross-entropy, where a cell counts by (range / 20 m) + 0.2: a wrong hit errs by its whole range;
    intensity: squared error where a return was expected and recorded.
    """
    assert spec.training is not None
    example = examples[int(torch.randint(len(examples), (), generator=generator))]
    height, width = example.true_range_m.shape
    margin = len(network.layers)
    inner = min(width, max(1, spec.training.rays // height))
    first = int(torch.randint(width, (), generator=generator))
    strip = example.columns((torch.arange(-margin, inner + margin) + first) % width)
    correction = network(strip.features[None])
    kept = slice(margin, margin + inner)
    expected_m = strip.range_m[:, kept]
    there = expected_m > 0.0
    truth_m = strip.true_range_m[:, kept]
    returned = truth_m > 0.0
    hit = (strip.hit_logit + correction.hit_logit[0])[:, kept]
    weight = torch.where(returned, truth_m, expected_m) / _TYPICAL_RANGE_M + 0.2
    both = there & returned
    brightness = torch.sigmoid(strip.intensity_logit + correction.intensity_logit[0])[:, kept]
    terms = {
        "hit": (weight * binary_cross_entropy_with_logits(hit, returned.float(), reduction="none"))[there],
        "intensity": (brightness - strip.true_intensity[:, kept]).square()[both],
    }
    return total_loss(terms, {"hit": losses.hit, "intensity": losses.intensity})
