"""Nothing stands between the sensor and its return."""

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError

_FIRST = 0.02
_FINAL_SHARE = 0.1
_SIGMAS = 3.0
"""The shell's half width in standard deviations of the weights wanted in it."""


def shell_half_width(
    step: int, steps: int, first: float = _FIRST, final_share: float = _FINAL_SHARE
) -> float:
    """Half width of the shell at a step: `first` times `final_share` to the power step / steps.

    The authors' numbers are the defaults, in scaled units: 0.02 to 0.002.
    """
    return first * float(final_share ** (step / max(1, steps)))


def line_of_sight_loss(weights: Tensor, t: Tensor, true_range: Tensor, epsilon: float) -> Tensor:
    """Squared difference (r,) of a ray's weights from those of one surface at its return, over all samples.

    Wanted are 0 outside [z - epsilon, z + epsilon] and, inside, a normal distribution about z with standard
    deviation epsilon / 3, cut off there and integrated over each sample's stretch (between the middles to
    its neighbours), so that they sum to 1 however thin the shell is. Rays without a return count 0.

    Source: Rematas et al., Urban Radiance Fields, 2022, the terms L_empty, L_near and L_dist of L_sight, with
    sums over samples for integrals. Not in the paper; in its authors' code, switched off.

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
    # The share of the normal distribution below each border, of what lies within the shell.
    # Its inverse has to be a number: 0 * inf would be NaN where a border lies on the return.
    thinnest = _SIGMAS * torch.finfo(t.dtype).tiny
    sigmas = ((borders - true_range[:, None]) * (_SIGMAS / max(epsilon, thinnest))).clamp(-_SIGMAS, _SIGMAS)
    within = torch.special.erf(torch.tensor(_SIGMAS / 2.0**0.5, dtype=t.dtype, device=t.device))
    below = 0.5 * (1.0 + torch.special.erf(sigmas / 2.0**0.5) / within)
    error = ((weights - (below[:, 1:] - below[:, :-1])) ** 2).sum(dim=1)
    return error * (true_range > 0)
