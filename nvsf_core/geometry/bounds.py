"""Conversion between scene-local metres and the unit cube in which a field is defined."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.errors import DataError, ShapeError

OUTERMOST_SHARE = 1e-3
"""Share of the points, per axis, that may lie outside a scene's box, half of them at each end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """A cube around a scene. In scaled units, metres from its centre divided by `half_m`, it spans -1..1."""

    centre_m: tuple[float, float, float]
    """Scene-local metres."""
    half_m: float
    bound: float = 1.0
    """The unit cube spans plus/minus this in scaled units; the authors' 2 leaves half of every axis empty."""

    @staticmethod
    def around(low_m: tuple[float, ...], high_m: tuple[float, ...]) -> "Bounds":
        """The smallest cube around a box (lower and upper corner), with a metre of margin."""
        centre = tuple(0.5 * (a + b) for a, b in zip(low_m, high_m, strict=True))
        half = 0.5 * max(b - a for a, b in zip(low_m, high_m, strict=True)) + 1.0
        return Bounds(centre_m=(centre[0], centre[1], centre[2]), half_m=half)

    @staticmethod
    def of_points(
        points_m: np.ndarray, *, outermost_share: float = OUTERMOST_SHARE, bound: float = 1.0
    ) -> "Bounds":
        """The cube of a scene: "point clouds are centred and scaled such that they fall within a unit cube".

        Of points (n, 3), scene-local metres. Centre: the middle of the box of all but the outermost points of
        each axis, a share in [0, 1), half at either end; half edge: that box's longest half axis. The
        authors' box, from the extremes (share 0), is moved by one stray point.

        Raises:
            ShapeError: The points are not (n, 3) with n > 0.
            DataError: A coordinate is not finite, or all points are one.
        """
        if points_m.ndim != 2 or points_m.shape[1] != 3 or len(points_m) == 0:
            raise ShapeError(f"Bounds.of_points: expected (n, 3) with n > 0, found {points_m.shape}")
        if not np.isfinite(points_m).all():
            bad = int((~np.isfinite(points_m)).any(axis=1).sum())
            raise DataError(
                f"Bounds.of_points: {bad} of {len(points_m)} points are not finite; drop them first"
            )
        tails = (0.5 * outermost_share, 1.0 - 0.5 * outermost_share)
        low, high = np.quantile(points_m.astype(np.float64), tails, axis=0)
        half_m = float((high - low).max()) / 2.0
        if half_m == 0.0:
            raise DataError(
                f"Bounds.of_points: all {len(points_m)} points are the same; a scene has an extent"
            )
        x, y, z = ((high + low) / 2.0).tolist()
        return Bounds(centre_m=(x, y, z), half_m=half_m, bound=bound)

    @property
    def edge_m(self) -> float:
        """Edge of the cube."""
        return 2.0 * self.half_m

    def to_unit(self, points_m: Tensor) -> Tensor:
        """(n, 3) metres to (n, 3) in [0, 1] inside the unit cube: ``(p - c) / (2 half_m bound) + 0.5``."""
        return (points_m - self._centre_m(points_m)) / (self.edge_m * self.bound) + 0.5

    def to_scaled(self, points_m: Tensor) -> Tensor:
        """(n, 3) metres to scaled units: ``(p - c) / half_m``."""
        return (points_m - self._centre_m(points_m)) / self.half_m

    def to_metres(self, points_scaled: Tensor) -> Tensor:
        """(n, 3) scaled units to scene-local metres."""
        return points_scaled * self.half_m + self._centre_m(points_scaled)

    def scaled(self, length_m: float) -> float:
        """A length in scaled units; lengths come back with ``* half_m``."""
        return length_m / self.half_m

    def _centre_m(self, like: Tensor) -> Tensor:
        return torch.tensor(self.centre_m, dtype=like.dtype, device=like.device)
