"""From scene-local metres to the unit cube in which a field is laid out, and nowhere else."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """A cube around what the evidence proves."""

    centre_m: tuple[float, float, float]
    """Scene-local."""
    half_m: float
    """Half the edge."""

    @staticmethod
    def around(low_m: tuple[float, ...], high_m: tuple[float, ...], *, margin_m: float = 1.0) -> "Bounds":
        """The smallest cube around a box (lower and upper corner), with a margin."""
        centre = tuple(0.5 * (a + b) for a, b in zip(low_m, high_m, strict=True))
        half = 0.5 * max(b - a for a, b in zip(low_m, high_m, strict=True)) + margin_m
        return Bounds(centre_m=(centre[0], centre[1], centre[2]), half_m=half)

    @property
    def edge_m(self) -> float:
        """Edge of the cube."""
        return 2.0 * self.half_m

    def to_unit(self, points_m: Tensor) -> Tensor:
        """(n, 3) metres to (n, 3) in [0, 1] inside the cube, outside of it beyond."""
        return (points_m - torch.tensor(self.centre_m)) / self.edge_m + 0.5

    def to_contracted_unit(self, points_m: Tensor) -> Tensor:
        """(n, 3) metres to (n, 3) in (0, 1): the cube fills the middle half of each axis, the rest all space.

        u = (p - c) / half; u stays where its largest coordinate m is at most 1, else becomes (2 - 1/m) u / m.
        Source: Barron et al., mip-NeRF 360, eq. 10, with the maximum norm.
        """
        u = (points_m - torch.tensor(self.centre_m)) / self.half_m
        m = u.abs().amax(dim=-1, keepdim=True).clamp_min(1.0)
        return (2.0 - 1.0 / m) * u / m / 4.0 + 0.5
