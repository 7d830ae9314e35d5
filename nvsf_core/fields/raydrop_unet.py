"""The U-Net that refines the hit probabilities of a whole pano (paper, Fig. 2, item 6)."""

import math
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, pad

from nvsf_core.errors import RecipeError, ShapeError
from nvsf_core.fields.layers import undrawn

_DROPOUT = 0.1
_HEADS = 8
_STAGES = 4
_GROWTH = (1, 2, 4, 8, 8)
"""Channels at each resolution, in multiples of the first one's."""


class RaydropUnet(nn.Module):
    """Refines the hit probabilities of a pano, from them, intensity and range.

    Four halvings, self-attention at a sixteenth of the resolution, four doublings with skip connections;
    6,535,969 parameters at 32 channels. Dropout in training uses torch's global generator.
    """

    def __init__(self, channels: int, generator: torch.Generator) -> None:
        """Sample all weights from `generator`.

        Raises:
            RecipeError: `channels` is below 1, or eight attention heads cannot share the deepest ones evenly.
        """
        super().__init__()
        if channels < 1:
            raise RecipeError(f"RaydropUnet: expected at least 1 channel, found {channels}; 0 = no U-Net")
        width = [channels * factor for factor in _GROWTH]
        self.enter = undrawn(nn.Conv2d, 3, width[0], 1)
        self.down = nn.ModuleList(_double_convolution(width[k], width[k + 1]) for k in range(_STAGES))
        self.attention = _Attention(width[-1])
        self.up = nn.ModuleList(
            _double_convolution(2 * width[k], width[max(k - 1, 0)]) for k in reversed(range(_STAGES))
        )
        self.leave = nn.Sequential(nn.BatchNorm2d(width[0]), nn.ReLU(), undrawn(nn.Conv2d, width[0], 1, 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                _initialise(module, generator)

    def forward(self, pano: Tensor) -> Tensor:
        """Logits of the refined hit probability.

        Args:
            pano: (b, 3, h, w): hit probability, intensity, range in scaled units; h and w at least 16.

        Returns:
            (b, h, w).

        Raises:
            ShapeError: The pano is too small to be halved four times, or does not have three channels.
        """
        smallest = 1 << _STAGES
        if pano.ndim != 4 or pano.shape[1] != 3 or min(pano.shape[2:]) < smallest:
            raise ShapeError(
                f"RaydropUnet: expected (b, 3, h, w) with h and w at least {smallest}, found "
                f"{tuple(pano.shape)}; leave the refinement out (recipe's refinement.channels = 0)"
            )
        levels = [self.enter(pano)]
        for block in self.down:
            levels.append(block(max_pool2d(levels[-1], 2)))
        x = self.attention(levels[-1])
        for block, skip in zip(self.up, reversed(levels[:-1]), strict=True):
            x = block(torch.cat([skip, _doubled(x, skip)], dim=1))
        return self.leave(x)[:, 0]

    def expect(self, hit_share: float) -> None:
        """Set the last bias to the log-odds of the training panos' share of hits, within 0.001 to 0.999."""
        known = min(max(hit_share, 1e-3), 1.0 - 1e-3)
        last = cast(nn.Conv2d, self.leave[-1])
        with torch.no_grad():
            cast(Tensor, last.bias).fill_(math.log(known / (1.0 - known)))


class _Attention(nn.Module):
    """Self-attention between all pixels, added to its input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        if channels % _HEADS:
            raise RecipeError(f"RaydropUnet: expected channels in multiples of {_HEADS}, found {channels}")
        self.norm = nn.BatchNorm2d(channels)
        self.qkv = undrawn(nn.Conv2d, channels, 3 * channels, 1, bias=False)
        self.mix = undrawn(nn.Conv2d, channels, channels, 1, bias=False)
        self.keep = nn.Dropout(_DROPOUT)

    def forward(self, x: Tensor) -> Tensor:
        b, c, h, w = x.shape
        parts = self.qkv(self.norm(x)).reshape(b, 3, _HEADS, c // _HEADS, h * w)
        query, key, value = parts.transpose(3, 4).unbind(1)
        logits = query @ key.transpose(2, 3) * (c // _HEADS) ** -0.5
        # In training a tenth of the links is cut. The most negative finite number makes a row of cut links
        # uniform; minus infinity would make it NaN.
        cut = self.keep(torch.ones_like(logits)) == 0.0
        links = logits.masked_fill(cut, torch.finfo(logits.dtype).min).softmax(dim=-1)
        mixed = (links @ value).transpose(2, 3).reshape(b, c, h, w)
        return x + self.mix(mixed)


def _double_convolution(inputs: int, outputs: int) -> nn.Sequential:
    """Twice: normalise, ReLU, dropout, 3 x 3 convolution; in between, channels of the wider end."""
    middle = max(inputs, outputs)
    layers: list[nn.Module] = []
    for fan_in, fan_out in ((inputs, middle), (middle, outputs)):
        convolution = undrawn(nn.Conv2d, fan_in, fan_out, 3, padding=1, bias=False)
        layers += [nn.BatchNorm2d(fan_in), nn.ReLU(), nn.Dropout2d(_DROPOUT), convolution]
    return nn.Sequential(*layers)


def _doubled(x: Tensor, like: Tensor) -> Tensor:
    """Twice the size, padded with zeros below and to the right to the size of `like`."""
    x = interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
    return pad(x, (0, like.shape[3] - x.shape[3], 0, like.shape[2] - x.shape[2]))


def _initialise(convolution: nn.Conv2d, generator: torch.Generator) -> None:
    """Initialise as torch does, but from an explicit generator: uniform within 1 / sqrt(inputs)."""
    weight = convolution.weight
    bound = weight[0].numel() ** -0.5
    nn.init.uniform_(weight, -bound, bound, generator=generator)
    if convolution.bias is not None:
        nn.init.uniform_(convolution.bias, -bound, bound, generator=generator)
