"""What the cameras learn: which depths to believe, and how to blend what recorded images show there."""

import math
from collections.abc import Iterable, Iterator
from typing import TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from nvsf_core.fields.layers import undrawn
from nvsf_core.recipe import CameraSpec

_Layer = TypeVar("_Layer", nn.Conv2d, nn.Conv3d)

HYPOTHESES = 3
"""Depths that a pixel's colour is looked up at: the two that images agree on best, and the LiDAR's."""
VOLUME_FEATURES = 12
"""Channels that describe a depth plane of a pixel."""
_RESIDUAL_MOST = 0.25
"""Most that a colour may differ from a blend of what was seen, of 0..1."""
_UNSEEN_LOGIT = -30.0
_COARSE_PRIOR = 0.05
"""Share of the coarse colour in the blend before anything is learned."""
_SHRINKS_BY = 8
_OFFSET = torch.tensor([0.02, 0.01, 0.01])
"""What each hypothesis is believed at least before anything is learned."""


class DepthNetwork(nn.Module):
    """Logits of a pixel's depth planes from how well the sources agree there; 3-D, two strides deep."""

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Draw all weights from `generator`."""
        super().__init__()
        a, b = spec.depth_channels
        self.near = _drawn(undrawn(nn.Conv3d, VOLUME_FEATURES, 8, 1), generator)
        self.down = _drawn(
            undrawn(nn.Conv3d, VOLUME_FEATURES, a, 3, stride=cast(int, (1, 2, 2)), padding=1), generator
        )
        self.deep = _drawn(undrawn(nn.Conv3d, a, b, 3, stride=2, padding=1), generator)
        self.deepest = _drawn(undrawn(nn.Conv3d, b, b, 3, padding=1), generator)
        self.raise_deep = _drawn(undrawn(nn.Conv3d, b, a, 1), generator)
        self.join = _drawn(undrawn(nn.Conv3d, a, a, 3, padding=1), generator)
        self.raise_join = _drawn(undrawn(nn.Conv3d, a, 8, 1), generator)
        self.logit = _drawn(undrawn(nn.Conv3d, 8, 1, 1), generator)

    def forward(self, features: Tensor) -> Tensor:
        """(d, h, w) logits from `features` (VOLUME_FEATURES, d, h, w)."""
        volume = features.transpose(0, 1).contiguous(memory_format=torch.channels_last)
        wide = functional.relu(_by_plane(self.down, volume))
        deep = functional.relu(_by_plane(self.deepest, functional.relu(_by_plane(self.deep, wide))))
        raised = _resized_planes(_by_plane(self.raise_deep, deep), wide)
        wide = functional.relu(_by_plane(self.join, wide + raised))
        raised = _resized_planes(_by_plane(self.raise_join, wide), volume)
        full = functional.relu(_by_plane(self.near, volume) + raised)
        return _by_plane(self.logit, full)[:, 0]


class RefineNetwork(nn.Module):
    """Probabilities of depths around each hypothesis, from how well the sources agree there.

    Before training, each hypothesis keeps the share it came with, spread evenly over its depths.
    """

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Draw all weights from `generator`."""
        super().__init__()
        count, w = spec.refinements, spec.refined_channels
        self.first = _drawn(undrawn(nn.Conv2d, 2 * count + 3, w, 3, padding=1), generator)
        self.wide = _drawn(undrawn(nn.Conv2d, w, w, 3, padding=2, dilation=2), generator)
        self.out = _drawn(undrawn(nn.Conv2d, w, count, 3, padding=1), generator)
        with torch.no_grad():
            self.out.weight.zero_()

    def forward(self, spread: Tensor, pair: Tensor, shown: Tensor, share: Tensor) -> Tensor:
        """Probability (c, h, w) of each hypothesis' depths, c = hypotheses x refinements; they add up to 1.

        Args:
            spread: (c, h, w) mean distance of the sources to their mean.
            pair: (c, h, w) distance of the two nearest.
            shown: (c, h, w) share of sources that show it.
            share: (3, h, w) in 0..1, how far each hypothesis is believed.
        """
        believed = (share + _OFFSET[:, None, None])[:, None]
        is_lidar = torch.zeros_like(believed)
        is_lidar[-1] = 1.0
        spread, pair, shown = (x.reshape(HYPOTHESES, -1, *x.shape[1:]) for x in (spread, pair, shown))
        x = torch.cat([4.0 * spread, 4.0 * pair, shown.mean(dim=1, keepdim=True), believed, is_lidar], dim=1)
        x = x.contiguous(memory_format=torch.channels_last)
        x = functional.relu(self.wide(functional.relu(self.first(x))))
        logits = self.out(x) + believed.log()
        return logits.flatten(0, 1).softmax(dim=0)


class BlendNetwork(nn.Module):
    """A pixel's colour: a weighted mean of what the sources show at its hypotheses, plus a small residual.

    Silent before training: the mean then follows what the depth network believes and how near a
    source is, and the residual is 0.
    """

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Draw all weights from `generator`."""
        super().__init__()
        self.seen = HYPOTHESES * spec.sources
        w, deep = spec.blend_channels
        self.first = _drawn(
            undrawn(nn.Conv2d, 4 * self.seen + HYPOTHESES + 3, w, 4, stride=2, padding=1), generator
        )
        self.second = _drawn(undrawn(nn.Conv2d, w, w, 3, padding=1), generator)
        self.down = _drawn(undrawn(nn.Conv2d, w, deep, 3, stride=2, padding=1), generator)
        self.mixed = _drawn(undrawn(nn.Conv2d, deep, deep, 3, padding=1), generator)
        self.deep = _drawn(undrawn(nn.Conv2d, deep, deep, 3, stride=2, padding=1), generator)
        self.deepest = _drawn(undrawn(nn.Conv2d, deep, deep, 3, padding=1), generator)
        self.raise_deep = _drawn(undrawn(nn.Conv2d, deep, deep, 1), generator)
        self.join = _drawn(undrawn(nn.Conv2d, deep, deep, 3, padding=1), generator)
        self.raise_join = _drawn(undrawn(nn.Conv2d, deep, w, 1), generator)
        self.last = _drawn(undrawn(nn.Conv2d, w, w, 3, padding=1), generator)
        self.out = _drawn(undrawn(nn.Conv2d, w, 4 * (self.seen + 1 + 3), 3, padding=1), generator)
        with torch.no_grad():
            self.out.weight.zero_()

    def forward(
        self, colour: Tensor, seen: Tensor, share: Tensor, coarse: Tensor, nearness: Tensor
    ) -> Tensor:
        """Colour (3, h, w), about 0..1.

        Args:
            colour: (s, 3, h, w) of s = hypotheses x sources, a hypothesis' sources side by side.
            seen: (s, h, w) bool, the source shows it.
            share: (3, h, w) in 0..1, how far each hypothesis is believed.
            coarse: (3, h, w), the mean over all depth planes, blurred and without holes.
            nearness: (k,) of the sources, 1 for the nearest.
        """
        height, width = coarse.shape[-2:]
        weighted = seen * nearness.repeat(HYPOTHESES)[:, None, None]
        offset = ((colour - coarse) * seen[:, None]).flatten(0, 1)
        out = self._network(torch.cat([offset, weighted, share, coarse - 0.5])[None])[:, :height, :width]
        believed = share + _OFFSET[:, None, None]
        prior = (believed[:, None] * nearness[None, :, None, None]).flatten(0, 1)
        prior = torch.cat([prior, torch.full_like(prior[:1], _COARSE_PRIOR)])
        # A place holder's nearness is 0, whose logarithm has no gradient.
        prior = prior.clamp_min(1e-6).log()
        logits = out[: self.seen + 1] + prior
        shown = torch.cat([seen, torch.ones_like(seen[:1])])
        weights = torch.where(shown, logits, _UNSEEN_LOGIT).softmax(dim=0)
        blended = (weights[:-1, None] * colour).sum(dim=0) + weights[-1] * coarse
        return blended + _RESIDUAL_MOST * torch.tanh(out[self.seen + 1 :])

    def _network(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        x = functional.pad(x, (0, -width % _SHRINKS_BY, 0, -height % _SHRINKS_BY), mode="replicate")
        x = x.contiguous(memory_format=torch.channels_last)
        wide = functional.relu(self.second(functional.relu(self.first(x))))
        mixed = functional.relu(self.mixed(functional.relu(self.down(wide))))
        deep = functional.relu(self.deepest(functional.relu(self.deep(mixed))))
        mixed = functional.relu(self.join(mixed + _resized(self.raise_deep(deep), mixed)))
        wide = functional.relu(self.last(wide + _resized(self.raise_join(mixed), wide)))
        # Two by two outputs of a pixel of half resolution are its four pixels.
        return functional.pixel_shuffle(self.out(wide), 2)[0]


class CameraNetworks(nn.Module):
    """One member of a drive's networks, all that shows a view; shared by the drive's cameras."""

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Draw all weights from `generator`."""
        super().__init__()
        self.depth = DepthNetwork(spec, generator)
        self.blend = BlendNetwork(spec, generator)
        self.refine = RefineNetwork(spec, generator) if spec.refinements else None


class CameraEnsemble(nn.Module):
    """Members that learn the same, each from weights and windows of its own; a view shows their mean.

    What each makes of the few images by chance is another thing for another, and the mean has less of it.
    """

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Draw all weights from `generator`, a member's after the other's."""
        super().__init__()
        self.members = nn.ModuleList(CameraNetworks(spec, generator) for _ in range(spec.members))

    def __iter__(self) -> Iterator[CameraNetworks]:
        """The members, as ModuleList does not type them."""
        return iter(cast(Iterable[CameraNetworks], self.members))


def _resized(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, like.shape[2:], mode="nearest")


def _by_plane(layer: nn.Conv3d, x: Tensor) -> Tensor:
    """A 3-D convolution of planes (d, c, h, w): 2-D ones of each and its neighbours, added.

    They are two to three times as fast on a CPU.
    """
    weight, step = layer.weight, layer.stride[0]
    if weight.shape[2] == 1:
        return functional.conv2d(x, weight[:, :, 0], layer.bias)
    sideways = layer.stride[1:]
    own = functional.conv2d(x[::step], weight[:, :, 1], layer.bias, sideways, padding=1)
    before, after = x[step - 1 :: step][: len(own) - 1], x[1::step]
    nearer = functional.conv2d(before, weight[:, :, 0], None, sideways, padding=1)
    farther = functional.conv2d(after, weight[:, :, 2], None, sideways, padding=1)
    # Beyond the first and the last plane there is nothing, which adds 0.
    nearer = functional.pad(nearer, (0, 0, 0, 0, 0, 0, 1, 0))
    return own + nearer + functional.pad(farther, (0, 0, 0, 0, 0, 0, 0, len(own) - len(after)))


def _resized_planes(x: Tensor, like: Tensor) -> Tensor:
    """Planes (d, c, h, w) repeated to the number and size of others'."""
    volume = x.transpose(0, 1)[None]
    return functional.interpolate(volume, (len(like), *like.shape[2:]), mode="nearest")[0].transpose(0, 1)


def _drawn(layer: _Layer, generator: torch.Generator) -> _Layer:
    """Weights uniform with a variance of 1 over the number of inputs; biases 0."""
    bound = math.sqrt(3.0 / layer.weight[0].numel())
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        if layer.bias is not None:
            layer.bias.zero_()
    return layer
