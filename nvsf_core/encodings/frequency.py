"""Sines and cosines of octaves of a coordinate."""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

__all__ = ["frequency_encode", "frequency_outputs"]


def frequency_outputs(dimensions: int, frequencies: int) -> int:
    """Numbers in the frequency encoding: sine and cosine of each octave of each coordinate."""
    return 2 * dimensions * frequencies


def frequency_encode(x: Tensor, frequencies: int) -> Tensor:
    """``sin(2^k pi x), cos(2^k pi x)`` for k = 0 .. frequencies - 1.

    Whole turns are taken off before the sine (exactly: a power of two times x rounds nothing), so that high
    octaves are as precise as low ones in float32.

    Args:
        x: (..., d) floating, any finite number.
        frequencies: number of octaves, at least 1.

    Returns:
        (..., 2 * d * frequencies): for each coordinate, for each octave, sine then cosine (tiny-cuda-nn).
    """
    octaves = torch.tensor([2.0**k for k in range(frequencies)], dtype=x.dtype, device=x.device)
    # Before the octaves too, or a large x times a high octave is infinite.
    half_turns = _within_a_turn(x)[..., None] * octaves
    angle_rad = pi * _within_a_turn(half_turns)
    return torch.stack([torch.sin(angle_rad), torch.cos(angle_rad)], dim=-1).flatten(-3)


def _within_a_turn(half_turns: Tensor) -> Tensor:
    """The same angle, in [-1, 1] half turns."""
    return half_turns - 2.0 * torch.round(half_turns.detach() / 2.0)
