"""The depth network: it chooses the depth of a recorded image's pixels by how well others agree there."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from nvsf_core.fields.layers import undrawn
from nvsf_core.kernels.images.plane_features import N_FEATURES
from nvsf_core.recipe.residual import CameraSpec

_FULL_CHANNELS = 8
"""Channels at the resolution of the planes themselves."""
_PLANE_PRIOR = (-4.0, -2.0, -8.0, -4.0, 0.0, 4.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Weights of a plane's features in its logit before training: where images agree, and returns lie."""


class DepthNetwork(nn.Module):
    """Logits of each pixel's depth planes, from how well the source images agree there.

    A 3-D encoder and decoder with skip connections, at three resolutions.
    """

    def __init__(self, spec: CameraSpec, generator: torch.Generator) -> None:
        """Sample all weights from `generator`."""
        super().__init__()
        a, b = spec.depth_channels
        self.near = _layer(generator, N_FEATURES, _FULL_CHANNELS, 1)
        self.down = _layer(generator, N_FEATURES, a, 3, stride=(1, 2, 2), padding=1)
        self.deep = _layer(generator, a, b, 3, stride=2, padding=1)
        self.deepest = _layer(generator, b, b, 3, padding=1)
        self.raise_deep = _layer(generator, b, a, 1)
        self.join = _layer(generator, a, a, 3, padding=1)
        self.raise_join = _layer(generator, a, _FULL_CHANNELS, 1)
        self.logit = _layer(generator, _FULL_CHANNELS, 1, 1)
        self.prior = _layer(generator, N_FEATURES, 1, 1)
        with torch.no_grad():
            self.logit.weight.zero_()
            self.prior.weight[0, :, 0, 0, 0] = torch.tensor(_PLANE_PRIOR)

    def forward(self, features: Tensor) -> Tensor:
        """Logits (d, h, w) of d planes from their `features` (d, N_FEATURES, h, w)."""
        volume = features.contiguous(memory_format=torch.channels_last)
        wide = functional.relu(_by_plane(self.down, volume))
        deep = functional.relu(_by_plane(self.deepest, functional.relu(_by_plane(self.deep, wide))))
        raised = _resized_planes(_by_plane(self.raise_deep, deep), wide)
        wide = functional.relu(_by_plane(self.join, wide + raised))
        raised = _resized_planes(_by_plane(self.raise_join, wide), volume)
        full = functional.relu(_by_plane(self.near, volume) + raised)
        return (_by_plane(self.logit, full) + _by_plane(self.prior, volume))[:, 0]


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
    planes = functional.interpolate(x, like.shape[2:], mode="nearest")
    return planes if len(planes) == len(like) else planes.repeat_interleave(2, dim=0)[: len(like)]


def _layer(generator: torch.Generator, *sizes: int, **options: int | tuple[int, ...]) -> nn.Conv3d:
    """A convolution with uniform weights of variance 1 / (number of inputs), and biases of 0."""
    layer = undrawn(nn.Conv3d, *sizes, **options)
    bound = math.sqrt(3.0 / layer.weight[0].numel())
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        if layer.bias is not None:
            layer.bias.zero_()
    return layer
