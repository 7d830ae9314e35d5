"""One training step of the network over a pano's cells."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from nvsf_core.fields.pano_network import PanoNetwork
from nvsf_core.losses.total import LossBreakdown, total_loss
from nvsf_core.recipe import LossWeights, PanoSpec

_MOST_ERROR_M = 3.0
"""A range that is farther off than this is wrong, however far."""
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
    """(CANDIDATES, h, w)."""
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

    hit: cross-entropy; intensity: squared error; choice: the expected error of the candidates, at most 3 m.
    Cells count by (range / 20 m) + 0.2: a wrong hit errs by its whole range.
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
    there = strip.range_m[1, :, kept] > 0.0
    truth_m = strip.true_range_m[:, kept]
    returned = truth_m > 0.0
    hit = (strip.hit_logit + correction.hit_logit[0])[:, kept]
    weight = torch.where(returned, truth_m, strip.range_m[1, :, kept]) / _TYPICAL_RANGE_M + 0.2
    both = there & returned
    brightness = torch.sigmoid(strip.intensity_logit + correction.intensity_logit[0])[:, kept]
    error_m = (strip.range_m[:, :, kept] - truth_m).abs().clamp_max(_MOST_ERROR_M)
    chosen = correction.choice[0, :, :, kept].softmax(dim=0)
    terms = {
        "hit": (weight * binary_cross_entropy_with_logits(hit, returned.float(), reduction="none"))[there],
        "intensity": (brightness - strip.true_intensity[:, kept]).square()[both],
        "depth": (chosen * error_m).sum(dim=0)[both],
    }
    return total_loss(terms, {"hit": losses.hit, "intensity": losses.intensity, "depth": losses.depth})
