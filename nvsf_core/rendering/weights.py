"""Alpha compositing in log space: how much each sample of a ray is seen."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from nvsf_core.errors import ShapeError

__all__ = ["weights_from_opacity_logits", "weights_from_optical_depth"]


def weights_from_optical_depth(optical_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the samples of each ray from their optical depths tau = density * length.

    ``w_i = exp(-sum of tau_j over j < i) * (1 - exp(-tau_i))`` and what passes all samples,
    ``exp(-sum of all tau_j)``. The transmittance is a sum of logarithms, never a product of nearly-ones,
    and 1 - exp is expm1: thin samples keep their weight and their gradient. Weights and the rest sum to 1.

    Args:
        optical_depth: (rays, samples) floating, at least 0, front to back; infinite is opaque; 0 marks a
            sample that is not there.

    Returns:
        weights (rays, samples) in [0, 1], transmittance_after (rays,) in [0, 1].

    Raises:
        ShapeError: not two axes.
    """
    _require_rays_and_samples(optical_depth, "weights_from_optical_depth")
    transmittance_before = torch.exp(-_sum_before(optical_depth))
    weights = transmittance_before * -torch.expm1(-optical_depth)
    return weights, torch.exp(-optical_depth.sum(dim=-1))


def weights_from_opacity_logits(logits: Tensor) -> tuple[Tensor, Tensor]:
    """The same from opacities alpha = sigmoid(logit).

    ``log(1 - alpha) = -softplus(logit)`` and ``log(alpha) = -softplus(-logit)``, so neither a nearly
    transparent nor a nearly opaque sample is rounded away; ``w_i = exp(log alpha_i + sum of
    log(1 - alpha_j) over j < i)``.

    Args:
        logits: (rays, samples) floating, front to back; -inf marks a sample that is not there.

    Returns:
        weights (rays, samples) in [0, 1], transmittance_after (rays,) in [0, 1].

    Raises:
        ShapeError: not two axes.
    """
    _require_rays_and_samples(logits, "weights_from_opacity_logits")
    optical_depth = -functional.logsigmoid(-logits)
    weights = torch.exp(functional.logsigmoid(logits) - _sum_before(optical_depth))
    return weights, torch.exp(-optical_depth.sum(dim=-1))


def _sum_before(optical_depth: Tensor) -> Tensor:
    """Exclusive cumulative sum; shifted rather than subtracted, which would cancel."""
    return torch.cumsum(functional.pad(optical_depth, (1, 0)), dim=-1)[:, :-1]


def _require_rays_and_samples(tensor: Tensor, function: str) -> None:
    if tensor.ndim != 2:
        raise ShapeError(f"{function}: expected (rays, samples), found {tuple(tensor.shape)}")
