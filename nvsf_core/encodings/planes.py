"""K-planes: features of space and time, factored into six planes a scale (paper, Fig. 2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nvsf_core.encodings.hash_time import SPACE_PLANES, two_slices
from nvsf_core.kernels.encodings.planes import planes_sample
from nvsf_core.recipe.paper import PlanesSpec

_SPACE_START = (0.1, 0.5)
"""Initial values of space planes are uniform in this interval; those of time planes are 1."""


class Planes4D(nn.Module):
    """Features of space ``xy * xz * yz`` and of time ``xt * yt * zt``, interpolated bilinearly at each scale.

    Source: Fridovich-Keil et al. 2023 (K-Planes): elementwise products, several resolutions of space.
    """

    def __init__(self, spec: PlanesSpec, generator: torch.Generator) -> None:
        """Sample the planes of space, scale by scale; those of time are all 1."""
        super().__init__()
        self.spec = spec
        widths = [scale * spec.space_resolution for scale in spec.scales]
        self.space = nn.ParameterList(
            torch.empty(spec.features, width, width).uniform_(*_SPACE_START, generator=generator)
            for width in widths
            for _ in SPACE_PLANES
        )
        self.time = nn.ParameterList(
            torch.ones(spec.features, spec.time_resolution, width) for width in widths for _ in range(3)
        )

    @property
    def outputs(self) -> int:
        """Length of a position's static, and of its dynamic, encoding."""
        return len(self.spec.scales) * self.spec.features

    def static(self, x01: Tensor) -> Tensor:
        """Encode positions (n, 3) in the unit cube (clamped) by space only: (n, scales * features)."""
        return self._products([x01[:, axes] for axes in SPACE_PLANES], list(self.space))

    def dynamic(self, x01: Tensor, t: float) -> Tensor:
        """Encode positions (n, 3) in the unit cube at a time in [0, 1] as (n, scales * features).

        A batch has one time, so each plane is interpolated over time first, to a line of height 1.
        """
        start = torch.zeros_like(x01[:, :1])
        along = [torch.cat([x01[:, axis : axis + 1], start], dim=1) for axis in range(3)]
        rows = two_slices(t, self.spec.time_resolution)
        lines = [_line(plane, rows) for plane in self.time]
        return self._products(along, lines)

    def _products(self, coordinates: list[Tensor], planes: list[Tensor]) -> Tensor:
        products = []
        for first in range(0, len(planes), 3):
            a, b, c = (planes_sample(coordinates[k], planes[first + k]) for k in range(3))
            products.append(a * b * c)
        return torch.cat(products, dim=1)


def _line(plane: Tensor, rows: list[tuple[int, float]]) -> Tensor:
    """A time plane (f, times, w) at one time, (f, 1, w): the weighted sum of one or two of its rows."""
    parts = [weight * plane[:, row : row + 1] for row, weight in rows]
    return parts[0] if len(parts) == 1 else parts[0] + parts[1]
