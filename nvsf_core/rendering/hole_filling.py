"""Colours for the pixels of an image that nothing shows."""

import torch
from torch import Tensor
from torch.nn import functional


def without_holes(colour: Tensor, share: Tensor) -> Tensor:
    """Colours (3, h, w) that are known for a `share`, the rest from ever larger surroundings.

    Args:
        colour: (3, h, w) in 0..1.
        share: (h, w), 0..1.
    """
    return _filled(colour * share, share)


def _filled(weighted: Tensor, share: Tensor) -> Tensor:
    both = torch.cat([weighted, share[None]])
    if min(share.shape) < 2:
        mean = both.mean(dim=(1, 2), keepdim=True)
        around = mean[:3] / mean[3:].clamp_min(1e-6)
    else:
        smaller = functional.avg_pool2d(both[None], 2, ceil_mode=True, count_include_pad=False)[0]
        coarse = _filled(smaller[:3], smaller[3])
        around = functional.interpolate(coarse[None], share.shape, mode="bilinear", align_corners=False)[0]
    return weighted + (1.0 - share) * around
