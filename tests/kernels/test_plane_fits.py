"""Planes in closed form are those of LAPACK's eigenvectors."""

import numpy as np
import pytest

from nvsf_core.kernels.plane_fits import fit_planes

RNG = np.random.default_rng(0)


def _covariances(spread_m: tuple[float, float, float], count: int = 500) -> np.ndarray:
    turns = np.linalg.qr(RNG.normal(size=(count, 3, 3)))[0]
    return np.einsum("vab,b,vcb->vac", turns, np.square(spread_m), turns)


@pytest.mark.parametrize(
    "spread_m",
    [(0.01, 0.06, 0.06), (0.0, 0.05, 0.06), (1e-5, 0.002, 0.06), (0.02, 0.021, 0.5), (3.0, 9.0, 9.5)],
)
def test_normals_and_spreads_are_lapacks(spread_m: tuple[float, float, float]) -> None:
    covariance = _covariances(spread_m)
    least, middle, normal = fit_planes(covariance)
    values, vectors = np.linalg.eigh(covariance)
    np.testing.assert_allclose(least, values[:, 0], rtol=0.0, atol=1e-12 * spread_m[2] ** 2)
    np.testing.assert_allclose(middle, values[:, 1], rtol=0.0, atol=1e-7 * spread_m[2] ** 2)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    along = np.abs(np.einsum("va,va->v", normal, vectors[:, :, 0]))
    assert along.min() > 1.0 - 1e-6


def test_points_on_a_line_or_at_one_place_have_no_plane() -> None:
    line = _covariances((0.0, 0.0, 0.06))
    alike = np.concatenate([np.zeros((1, 3, 3)), np.eye(3)[None], line])
    least, middle, normal = fit_planes(alike)
    assert np.isfinite(least).all() and np.isfinite(middle).all() and np.isfinite(normal).all()
    assert not normal[:2].any()
    along = np.linalg.eigh(line)[1][:, :, 2]
    assert np.abs(np.einsum("va,va->v", normal[2:], along)).max() < 1e-3  # what there is lies across the line
