"""Rays meet a mesh where its points were, and nothing where there were none."""

import numpy as np
import pytest

from nvsf_core.clouds.mesh import Mesh, mesh_rays, poisson_mesh
from nvsf_core.errors import DataError

pytestmark = pytest.mark.usefixtures("open3d")
DOWN = np.array([0.0, 0.0, -1.0], np.float32)


def _floor(has_hole: bool) -> np.ndarray:
    """A floor at z = 0.5 + 0.02 x, 8 m wide, points 10 cm apart, perhaps with a hole of radius 1 m."""
    x, y = np.meshgrid(np.arange(-4.0, 4.0, 0.1), np.arange(-4.0, 4.0, 0.1))
    points = np.stack([x.ravel(), y.ravel(), 0.5 + 0.02 * x.ravel()], axis=1)
    return points[np.hypot(points[:, 0], points[:, 1]) > 1.0] if has_hole else points


def _mesh(points_m: np.ndarray) -> Mesh:
    towards = np.broadcast_to(-DOWN, points_m.shape)
    intensity = np.where(points_m[:, 1] > 0.0, 0.8, 0.2)
    return poisson_mesh(points_m, towards, intensity, spacing_m=0.05, depth=7, trim_m=0.25)


def test_rays_end_on_the_surface_with_its_intensity_and_miss_beside_it() -> None:
    cast = mesh_rays(_mesh(_floor(has_hole=False)))
    origin = np.array([[0.3, 2.0, 3.0], [-2.0, -1.5, 3.0], [7.0, 0.0, 3.0]], np.float32)
    range_m, intensity = cast(origin, np.tile(DOWN, (3, 1)))
    np.testing.assert_allclose(range_m[:2], 3.0 - (0.5 + 0.02 * origin[:2, 0]), atol=0.02)
    np.testing.assert_allclose(intensity[:2], [0.8, 0.2], atol=1e-6)
    assert np.isinf(range_m[2]) and intensity[2] == 0.0


def test_poisson_closes_a_hole_and_trimming_opens_it_again() -> None:
    cast = mesh_rays(_mesh(_floor(has_hole=True)))
    origin = np.array([[0.0, 0.0, 3.0], [0.0, 2.0, 3.0]], np.float32)
    range_m, _ = cast(origin, np.tile(DOWN, (2, 1)))
    assert np.isinf(range_m[0]) and np.isfinite(range_m[1])


def test_too_few_points_are_refused_with_their_number() -> None:
    with pytest.raises(DataError, match="found 64"):
        _mesh(np.random.default_rng(0).uniform(-1.0, 1.0, (64, 3)))
