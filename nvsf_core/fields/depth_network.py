"""The camera networks: they choose a pixel's depths and blend the recorded images' colours there."""

import math
from typing import NamedTuple, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from nvsf_core.fields.layers import undrawn
from nvsf_core.recipe import CameraSpec

_Layer = TypeVar("_Layer", nn.Conv2d, nn.Conv3d)

HYPOTHESES = 3
"""Depths a pixel at which colours are looked up: the two where the images agree best, and the LiDAR's."""
VOLUME_FEATURES = 12
"""Channels that describe a depth plane of a pixel."""
_PLANE_PRIOR = (-4.0, -2.0, -8.0, -4.0, 0.0, 4.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Weights of a plane's features in its logit before training: where images agree, and returns lie."""
_RESIDUAL_MOST = 0.25
"""Largest difference of a colour from the blend of recorded colours; colours are 0..1."""
_UNSEEN_LOGIT = -30.0
"""Logit of the weight of a source that does not show the pixel."""
_COARSE_PRIOR = 0.05
"""Weight of the coarse colour in the blend before training, beside the hypotheses' probabilities."""
_NEARNESS_POWER = 1.5
"""With 2 views are sharper, with 1 their errors are smaller."""
_SHRINKS_BY = 8
"""Sides of the blend network's input are padded to multiples of this."""
_OFFSET = torch.tensor([0.02, 0.01, 0.01])
"""Added to each hypothesis' probability, so that none is 0."""


class DepthNetwork(nn.Module):
    """Logits of each pixel's depth planes, from how well the source images agree there.

    A 3-D encoder and decoder with skip connections, at three resolutions.
    """

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        a, b = spec.depth_channels
        self.near = _layer(generator, nn.Conv3d, VOLUME_FEATURES, 8, 1)
        self.down = _layer(generator, nn.Conv3d, VOLUME_FEATURES, a, 3, stride=(1, 2, 2), padding=1)
        self.deep = _layer(generator, nn.Conv3d, a, b, 3, stride=2, padding=1)
        self.deepest = _layer(generator, nn.Conv3d, b, b, 3, padding=1)
        self.raise_deep = _layer(generator, nn.Conv3d, b, a, 1)
        self.join = _layer(generator, nn.Conv3d, a, a, 3, padding=1)
        self.raise_join = _layer(generator, nn.Conv3d, a, 8, 1)
        self.logit = _layer(generator, nn.Conv3d, 8, 1, 1)
        self.prior = _layer(generator, nn.Conv3d, VOLUME_FEATURES, 1, 1)
        with torch.no_grad():
            self.logit.weight.zero_()
            self.prior.weight[0, :, 0, 0, 0] = torch.tensor(_PLANE_PRIOR)

    def forward(self, features: Tensor) -> Tensor:
        """Logits (d, h, w) of d planes from their `features` (d, VOLUME_FEATURES, h, w)."""
        volume = features.contiguous(memory_format=torch.channels_last)
        wide = functional.relu(_by_plane(self.down, volume))
        deep = functional.relu(_by_plane(self.deepest, functional.relu(_by_plane(self.deep, wide))))
        raised = _resized_planes(_by_plane(self.raise_deep, deep), wide)
        wide = functional.relu(_by_plane(self.join, wide + raised))
        raised = _resized_planes(_by_plane(self.raise_join, wide), volume)
        full = functional.relu(_by_plane(self.near, volume) + raised)
        return (_by_plane(self.logit, full) + _by_plane(self.prior, volume))[:, 0]


class BlendInput(NamedTuple):
    """What a pixel's colour is blended from: s = hypotheses x sources colours, hypothesis by hypothesis."""

    colour: Tensor
    """(s, 3, h, w) in 0..1."""
    coarse: Tensor
    """(3, h, w) colour at the view's front surface, blurred and without holes."""
    shown: Tensor
    """(s + 1, h, w) bool, whether the source shows the point; the coarse colour always is."""
    prior: Tensor
    """(s + 1, h, w) logit of each colour's weight before training."""
    features: Tensor
    """(1, c, h, w), the network's input."""

    @classmethod
    def of(
        cls, colour: Tensor, seen: Tensor, share: Tensor, coarse: Tensor, nearness: Tensor, trust: Tensor
    ) -> Self:
        """From what sources show.

        Args:
            colour: (s, 3, h, w) in 0..1.
            seen: (s, h, w) bool, whether the source shows the point.
            share: (3, h, w) probability of each hypothesis, 0..1.
            coarse: (3, h, w) colour, as the field of that name.
            nearness: (k,) of the sources, 1 for the nearest.
            trust: (s + 1, h, w) share of its weight that each colour keeps, 0..1; the last, the coarse one.
        """
        weighted = seen * nearness.repeat(HYPOTHESES)[:, None, None]
        offset = ((colour - coarse) * seen[:, None]).flatten(0, 1)
        believed = share + _OFFSET.to(share)[:, None, None]
        near = nearness.pow(_NEARNESS_POWER)[None, :, None, None]
        prior = (believed[:, None] * near).flatten(0, 1)
        prior = torch.cat([prior, torch.full_like(prior[:1], _COARSE_PRIOR)]) * trust
        # A placeholder source has nearness 0, whose logarithm is not finite.
        prior = prior.clamp_min(1e-6).log()
        shown = torch.cat([seen, torch.ones_like(seen[:1])])
        return cls(colour, coarse, shown, prior, torch.cat([offset, weighted, share, coarse - 0.5])[None])


class BlendNetwork(nn.Module):
    """A pixel's colour: a weighted mean of the sources' colours at its hypotheses, plus a small residual.

    Before training the weights are the hypotheses' probabilities, times a power of the sources' nearness,
    times how well they agree with each other, and the residual is 0 (decisions 0038 and 0049).
    """

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        self.seen = HYPOTHESES * spec.sources
        w, deep = spec.blend_channels
        self.first = _layer(generator, nn.Conv2d, 4 * self.seen + HYPOTHESES + 3, w, 4, stride=2, padding=1)
        self.second = _layer(generator, nn.Conv2d, w, w, 3, padding=1)
        self.down = _layer(generator, nn.Conv2d, w, deep, 3, stride=2, padding=1)
        self.mixed = _layer(generator, nn.Conv2d, deep, deep, 3, padding=1)
        self.deep = _layer(generator, nn.Conv2d, deep, deep, 3, stride=2, padding=1)
        self.deepest = _layer(generator, nn.Conv2d, deep, deep, 3, padding=1)
        self.raise_deep = _layer(generator, nn.Conv2d, deep, deep, 1)
        self.join = _layer(generator, nn.Conv2d, deep, deep, 3, padding=1)
        self.raise_join = _layer(generator, nn.Conv2d, deep, w, 1)
        self.last = _layer(generator, nn.Conv2d, w, w, 3, padding=1)
        self.out = _layer(generator, nn.Conv2d, w, 4 * (self.seen + 1 + 3), 3, padding=1)
        with torch.no_grad():
            self.out.weight.zero_()

    def forward(self, given: BlendInput) -> Tensor:
        """Colour (3, h, w), about 0..1."""
        height, width = given.coarse.shape[-2:]
        out = self._network(given.features)[:, :height, :width]
        logits = out[: self.seen + 1] + given.prior
        weights = torch.where(given.shown, logits, _UNSEEN_LOGIT).softmax(dim=0)
        blended = (weights[:-1, None] * given.colour).sum(dim=0) + weights[-1] * given.coarse
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
        # Each pixel of half resolution has outputs for its 2 x 2 pixels.
        return functional.pixel_shuffle(self.out(wide), 2)[0]


class CameraNetworks(nn.Module):
    """The networks that render a view; all cameras of a drive share them."""

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        self.depth = DepthNetwork(spec, generator)
        self.blend = BlendNetwork(spec, generator)


def _resized(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, like.shape[2:], mode="nearest")


def _by_plane(layer: nn.Conv3d, x: Tensor) -> Tensor:
    """A 3-D convolution of planes (d, c, h, w), as a sum of 2-D ones of each plane and its neighbours.

    On a CPU this is two to three times as fast.
    """
    weight, step = layer.weight, layer.stride[0]
    if weight.shape[2] == 1:
        return functional.conv2d(x, weight[:, :, 0], layer.bias)
    sideways = layer.stride[1:]
    own = functional.conv2d(x[::step], weight[:, :, 1], layer.bias, sideways, padding=1)
    before, after = x[step - 1 :: step][: len(own) - 1], x[1::step]
    nearer = functional.conv2d(before, weight[:, :, 0], None, sideways, padding=1)
    farther = functional.conv2d(after, weight[:, :, 2], None, sideways, padding=1)
    # Neighbours beyond the first and the last plane are 0.
    nearer = functional.pad(nearer, (0, 0, 0, 0, 0, 0, 1, 0))
    return own + nearer + functional.pad(farther, (0, 0, 0, 0, 0, 0, 0, len(own) - len(after)))


def _resized_planes(x: Tensor, like: Tensor) -> Tensor:
    """Planes (d, c, h, w), repeated to the number and size of those of `like`."""
    # By planes, with channels last in memory, torch resizes many times as fast as in 3-D.
    planes = _resized(x, like)
    return planes if len(planes) == len(like) else planes.repeat_interleave(2, dim=0)[: len(like)]


def _layer(
    generator: torch.Generator, kind: type[_Layer], *sizes: int, **options: int | tuple[int, ...]
) -> _Layer:
    """A convolution with uniform weights of variance 1 / (number of inputs), and biases of 0."""
    layer = undrawn(kind, *sizes, **options)
    bound = math.sqrt(3.0 / layer.weight[0].numel())
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        if layer.bias is not None:
            layer.bias.zero_()
    return layer
