"""Encodings of directions: real spherical harmonics of bands 0 to 3, and sines and cosines of octaves."""

from __future__ import annotations

from math import pi, sqrt

import torch
from torch import Tensor

from nvsf_core.errors import ShapeError

SPHERICAL_HARMONICS_OUTPUTS = 16

_BAND_0 = 0.5 * sqrt(1.0 / pi)
_BAND_1 = sqrt(3.0 / (4.0 * pi))
_BAND_2_CROSS = 0.5 * sqrt(15.0 / pi)
_BAND_2_ZZ = 0.25 * sqrt(5.0 / pi)
_BAND_2_XXYY = 0.25 * sqrt(15.0 / pi)
_BAND_3_OUTER = 0.25 * sqrt(35.0 / (2.0 * pi))
_BAND_3_XYZ = 0.5 * sqrt(105.0 / pi)
_BAND_3_INNER = 0.25 * sqrt(21.0 / (2.0 * pi))
_BAND_3_ZZZ = 0.25 * sqrt(7.0 / pi)
_BAND_3_XXYYZ = 0.25 * sqrt(105.0 / pi)


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The 16 orthonormal real harmonics of bands 0 to 3, with the Condon-Shortley sign.

    Ordered by band l, within it by m = -l..l. ``integral over the sphere of Y_i Y_j = 1 if i == j else 0``.

    Args:
        directions: (..., 3) unit vectors x, y, z.

    Returns:
        (..., 16).

    Raises:
        ShapeError: the last axis is not 3.
    """
    if directions.shape[-1] != 3:
        raise ShapeError(f"spherical_harmonics: expected (..., 3), found {tuple(directions.shape)}")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, _BAND_0),
            -_BAND_1 * y,
            _BAND_1 * z,
            -_BAND_1 * x,
            _BAND_2_CROSS * x * y,
            -_BAND_2_CROSS * y * z,
            _BAND_2_ZZ * (3.0 * zz - 1.0),
            -_BAND_2_CROSS * x * z,
            _BAND_2_XXYY * (xx - yy),
            -_BAND_3_OUTER * y * (3.0 * xx - yy),
            _BAND_3_XYZ * x * y * z,
            -_BAND_3_INNER * y * (5.0 * zz - 1.0),
            _BAND_3_ZZZ * z * (5.0 * zz - 3.0),
            -_BAND_3_INNER * x * (5.0 * zz - 1.0),
            _BAND_3_XXYYZ * z * (xx - yy),
            -_BAND_3_OUTER * x * (xx - 3.0 * yy),
        ],
        dim=-1,
    )


def frequency_encode(x: Tensor, frequencies: int) -> Tensor:
    """``sin(2^k pi x), cos(2^k pi x)`` for k = 0 .. frequencies - 1 >= 0, of any finite numbers (..., d).

    Multiples of 2 pi are subtracted before the sine, without rounding (a power of two times x is exact), so
    that high octaves are as precise as low ones. (..., 2 * d * frequencies): by coordinate, by octave, sine
    then cosine (as in tiny-cuda-nn).
    """
    octaves = torch.tensor([2.0**k for k in range(frequencies)], dtype=x.dtype, device=x.device)
    # Before the octaves too, or a large x times a high octave is infinite.
    half_turns = _within_a_turn(x)[..., None] * octaves
    angle_rad = pi * _within_a_turn(half_turns)
    return torch.stack([torch.sin(angle_rad), torch.cos(angle_rad)], dim=-1).flatten(-3)


def _within_a_turn(half_turns: Tensor) -> Tensor:
    """The same angle within [-1, 1] half turns (units of pi)."""
    return half_turns - 2.0 * torch.round(half_turns.detach() / 2.0)
