"""Ten million points encoded at the paper's size, in chunks, with the oracle on a sample of them."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.numerics.cases.case import NOT_ON_GPU, Case, Gradient, Reading
from benchmarks.numerics.cases.tolerances import TOLERANCES
from nvsf_core.kernels import GridLayout, hash_grid_encode, planes_sample

TITLE = "Ten million points, encoded"
_POINTS, _CHUNK, _SAMPLE = 10_000_000, 1_000_000, 100_000
_STATIC = GridLayout(levels=8, features=4, log2_table=19, base_resolution=512, finest_resolution=32768)
"""The paper's static hash."""
_PLANE = (8, 256, 256)
"""The paper's finest plane of space."""

_Encode = Callable[[Tensor, Tensor, bool], Tensor]
"""Positions (n, d) and entries to features (n, c); by the oracle or by the kernel."""


def _hash(positions: Tensor, table: Tensor, is_oracle: bool) -> Tensor:
    return hash_grid_encode(positions, table, _STATIC, backend="torch" if is_oracle else "numba")


def _plane(positions: Tensor, plane: Tensor, is_oracle: bool) -> Tensor:
    return planes_sample(positions, plane, backend="torch" if is_oracle else "numba")


def _encoded(encode: _Encode, entries: tuple[int, ...], axes: int) -> Reading:
    """Features and gradients of a sample are the oracle's; over all points the adjoint is the transpose.

    Numbers above 0 cancel nowhere: sum of c . E(x, T) is that of T . (dE/dT)^T c but for rounding.
    """
    table = torch.rand(entries, generator=torch.Generator().manual_seed(0))
    tolerance = TOLERANCES[torch.float32]
    eps = torch.finfo(torch.float32).eps
    worst = slope = forward = adjoint = 0.0
    for seed in range(_POINTS // _CHUNK):
        draws = torch.Generator().manual_seed(1 + seed)
        # A twelfth of the positions lies outside on each side of an axis.
        positions = torch.rand(_CHUNK, axes, generator=draws) * 1.2 - 0.1
        features, gradient, cotangent = _both(encode, positions, table, False, draws)
        forward += float((features * cotangent).double().sum())
        adjoint += float((gradient * table).double().sum())
        sample = slice(0, _CHUNK, _POINTS // _SAMPLE)
        expected = encode(positions[sample], table, True)
        worst = max(worst, float((features[sample] - expected).abs().max()))
        slope = max(slope, _slope_error(encode, positions[sample], table, seed))
    apart = abs(forward - adjoint) / forward
    is_finite = math.isfinite(apart)
    return Reading(
        error=worst, limit=tolerance.sum_eps * eps, float32="ok", cuda=NOT_ON_GPU,
        gradient=Gradient(is_finite, slope, tolerance.gradient),
        outcome=f"over all points the adjoint is the transpose to {apart:.1e}",
        is_refuted=not apart <= tolerance.gradient,
    )  # fmt: skip


def _both(
    encode: _Encode, positions: Tensor, table: Tensor, is_oracle: bool, draws: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Features, the gradient of their sum weighted with random numbers, and these numbers."""
    entries = table.clone().requires_grad_()
    features = encode(positions, entries, is_oracle)
    cotangent = torch.rand(features.shape, generator=draws)
    features.backward(cotangent)
    assert entries.grad is not None
    return features.detach(), entries.grad, cotangent


def _slope_error(encode: _Encode, positions: Tensor, table: Tensor, seed: int) -> float:
    """Largest difference of the kernel's gradient to the oracle's, relative to the largest entry."""
    ours, oracles = (
        _both(encode, positions, table, is_oracle, torch.Generator().manual_seed(seed))[1]
        for is_oracle in (False, True)
    )
    return float((ours - oracles).abs().max() / oracles.abs().max())


CASES = (
    Case(
        "kernels.encodings.hash_grid.hash_grid_encode",
        "1e7 points in ten chunks, oracle on 1e5; the paper's static hash",
        lambda: _encoded(_hash, (_STATIC.entries, _STATIC.features), 3),
    ),
    Case(
        "kernels.encodings.planes.planes_sample", "1e7 points in ten chunks, oracle on 1e5; 8 x 256 x 256",
        lambda: _encoded(_plane, _PLANE, 2),
    ),
)  # fmt: skip
