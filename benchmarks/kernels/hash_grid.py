"""Inputs on which hash grids are timed: three grids, and points along rays."""

import torch
from torch import Tensor

from nvsf_core.kernels import GridLayout

LAYOUTS = {
    "8 levels, F 2, T 2^17, 16..2048": GridLayout(8, 2, 17, 16, 2048),
    "8 levels, F 4, T 2^19, 16..2048": GridLayout(8, 4, 19, 16, 2048),
    "paper: 8 levels, F 4, T 2^19, 512..32768": GridLayout(8, 4, 19, 512, 32768),
}
_SAMPLES_PER_RAY = 32


def samples_on_rays(points: int, generator: torch.Generator) -> Tensor:
    """Positions (points, 3) in runs of near neighbours, as rays make them; `points` a multiple of 32."""
    rays = points // _SAMPLES_PER_RAY
    origins = torch.rand(rays, 1, 3, generator=generator)
    directions = torch.randn(rays, 1, 3, generator=generator)
    return (origins + torch.linspace(0, 0.05, _SAMPLES_PER_RAY)[:, None] * directions).reshape(-1, 3)
