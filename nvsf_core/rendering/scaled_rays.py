"""Rays in scaled units, in which the paper's field is trained."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nvsf_core.geometry.bounds import Bounds


@dataclass(frozen=True, slots=True)
class ScaledRays:
    """Rays in scaled units: metres from the scene's centre, divided by half the edge of its cube."""

    origin: Tensor
    """(r, 3) float32."""
    direction: Tensor
    """(r, 3) float32, unit."""
    near: Tensor
    """(r,) range of the first sample."""
    far: Tensor
    """(r,) range of the last sample."""

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.near)

    def part(self, rays: slice) -> "ScaledRays":
        """The rays of a slice."""
        return ScaledRays(self.origin[rays], self.direction[rays], self.near[rays], self.far[rays])

    def to(self, device: torch.device) -> "ScaledRays":
        """The same rays on a device."""
        return ScaledRays(*(x.to(device) for x in (self.origin, self.direction, self.near, self.far)))


def lidar_rays(
    bounds: Bounds, origin_m: np.ndarray, direction: np.ndarray, *, near_m: float, far_m: float
) -> ScaledRays:
    """Scaled rays of a LiDAR, all of the same length.

    Args:
        bounds: The scene's cube.
        origin_m: (r, 3) scene-local, metres.
        direction: (r, 3) unit, scene-local axes.
        near_m: Range of the first sample.
        far_m: Range of the last sample.
    """
    origin, towards = _scaled(bounds, origin_m), torch.from_numpy(direction.astype(np.float32))
    near = torch.full((len(towards),), bounds.scaled(near_m))
    return ScaledRays(origin, towards, near, torch.full_like(near, bounds.scaled(far_m)))


def camera_rays(bounds: Bounds, origin_m: np.ndarray, direction: np.ndarray, *, near_m: float) -> ScaledRays:
    """Scaled rays of a camera, from `near_m` up to where each leaves the unit cube.

    Origins, metres, and unit directions (r, 3) are scene-local. A ray that starts outside the cube is sampled
    only over one hundredth of `near_m`.
    """
    origin, towards = _scaled(bounds, origin_m), torch.from_numpy(direction.astype(np.float32))
    near = torch.full((len(towards),), bounds.scaled(near_m))
    far = torch.maximum(leave_box(origin, towards, bounds.bound), near * 1.01)
    return ScaledRays(origin, towards, near, far)


def leave_box(origin: Tensor, direction: Tensor, bound: float) -> Tensor:
    """Range (r,), at least 0, at which rays (r, 3), (r, 3) leave the cube [-bound, bound]^3.

    An axis along which a ray does not move is ignored.
    """
    moving = direction.abs() > 1e-12
    step = torch.where(moving, direction, torch.ones_like(direction))
    exits = torch.where(moving, (torch.sign(step) * bound - origin) / step, torch.inf)
    return exits.amin(dim=1).clamp_min(0.0)


def _scaled(bounds: Bounds, points_m: np.ndarray) -> Tensor:
    # The centre is subtracted in float64: scene-local coordinates may be hundreds of metres.
    centred = points_m.astype(np.float64) - np.array(bounds.centre_m)
    return torch.from_numpy((centred / bounds.half_m).astype(np.float32))
