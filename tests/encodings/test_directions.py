"""Laws of spherical harmonics and of the frequency encoding."""

import math

import numpy as np
import pytest
import torch

from nvsf_core.encodings.directions import (
    SPHERICAL_HARMONICS_OUTPUTS,
    frequency_encode,
    spherical_harmonics,
)
from nvsf_core.errors import ShapeError


def _sphere():
    """Points and weights of a quadrature that is exact for the products: Gauss in z, uniform in azimuth."""
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth_rad = np.arange(16) * 2 * np.pi / 16
    z, azimuth_rad = (a.ravel() for a in np.meshgrid(z, azimuth_rad, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    points = np.stack([radius * np.cos(azimuth_rad), radius * np.sin(azimuth_rad), z], axis=1)
    return torch.from_numpy(points), torch.from_numpy(np.repeat(weight, 16) * 2 * np.pi / 16)


def test_the_harmonics_are_orthonormal_on_the_sphere():
    points, weights = _sphere()
    y = spherical_harmonics(points)
    products = torch.einsum("n,ni,nj->ij", weights, y, y)
    assert torch.allclose(products, torch.eye(SPHERICAL_HARMONICS_OUTPUTS, dtype=torch.float64), atol=1e-12)


def test_a_direction_and_its_opposite_differ_in_the_odd_bands_only():
    points, _ = _sphere()
    band = torch.tensor([0] + [1] * 3 + [2] * 5 + [3] * 7)
    sign = 1.0 - 2.0 * (band % 2)
    assert torch.allclose(spherical_harmonics(-points), sign * spherical_harmonics(points))


def test_harmonics_keep_leading_axes_and_refuse_other_vectors():
    assert spherical_harmonics(torch.zeros(2, 4, 3)).shape == (2, 4, 16)
    with pytest.raises(ShapeError):
        spherical_harmonics(torch.zeros(2, 4))


def test_frequencies_are_ordered_by_coordinate_octave_sine_cosine():
    x = torch.tensor([[0.3, -0.7]], dtype=torch.float64)
    expected = [f(2**k * math.pi * c) for c in (0.3, -0.7) for k in range(12) for f in (math.sin, math.cos)]
    encoded = frequency_encode(x, 12)
    assert encoded.shape == (1, 2 * 2 * 12)
    assert encoded[0].tolist() == pytest.approx(expected, abs=1e-9)


def test_high_octaves_are_precise_in_float32():
    x = torch.linspace(-1, 1, 1001)
    precise = frequency_encode(x[:, None].double(), 12)
    assert (frequency_encode(x[:, None], 12).double() - precise).abs().max() < 1e-6


def test_the_frequency_encoding_passes_gradcheck():
    x = torch.tensor([[0.13, -0.71, 0.93]], dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: frequency_encode(v, 4), (x,))
