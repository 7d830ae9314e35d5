"""Line-of-sight loss: free space between the sensor and its return, one surface at the return."""

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError

_SIGMAS = 3.0
"""Half width of the shell around the return, in standard deviations of the target weights."""


def shell_half_width(step: int, steps: int) -> float:
    """Half width of the shell at `step` of `steps`, scaled units: 0.02 to 0.002, as in the authors' code."""
    return 0.02 * float(0.1 ** (step / max(1, steps)))


def line_of_sight_loss(weights: Tensor, t: Tensor, true_range: Tensor, epsilon: float) -> Tensor:
    """Sum over samples of the squared difference of a ray's weights from target weights, (r,).

    The targets are 0 outside [z - epsilon, z + epsilon]. Inside they are a normal distribution about z with
    standard deviation epsilon / 3, truncated there and integrated over each sample's interval (up to the
    middles to its neighbours), so that they sum to 1 however thin the shell is. Dropped rays count 0.

    Source: Rematas et al. 2022 (Urban Radiance Fields), the terms L_empty, L_near and L_dist of L_sight, with
    sums over samples for integrals. Not in the paper; in the authors' code, switched off.

    Args:
        weights: (r, s) of the samples, 0..1.
        t: (r, s) ascending distances of the samples.
        true_range: (r,) recorded z, same unit; 0 = no return.
        epsilon: Half width of the shell, same unit, above 0.

    Returns:
        (r,), no unit.

    Raises:
        ShapeError: Shapes do not fit or epsilon is not above 0.
    """
    if weights.shape != t.shape or t.ndim != 2 or true_range.shape != t.shape[:1] or not epsilon > 0.0:
        raise ShapeError(
            f"line_of_sight_loss: expected weights and t (r, s), ranges (r,), epsilon > 0, found "
            f"{tuple(weights.shape)}, {tuple(t.shape)}, {tuple(true_range.shape)}, {epsilon}"
        )
    middles = 0.5 * (t[:, 1:] + t[:, :-1])
    infinite = torch.full_like(t[:, :1], torch.inf)
    borders = torch.cat([-infinite, middles, infinite], dim=1)
    # The truncated distribution's share below each border.
    # 1 / epsilon has to be finite: 0 * inf would be NaN where a border lies on the return.
    thinnest = _SIGMAS * torch.finfo(t.dtype).tiny
    sigmas = ((borders - true_range[:, None]) * (_SIGMAS / max(epsilon, thinnest))).clamp(-_SIGMAS, _SIGMAS)
    within = torch.special.erf(torch.tensor(_SIGMAS / 2.0**0.5, dtype=t.dtype, device=t.device))
    below = 0.5 * (1.0 + torch.special.erf(sigmas / 2.0**0.5) / within)
    error = ((weights - (below[:, 1:] - below[:, :-1])) ** 2).sum(dim=1)
    return error * (true_range > 0)
