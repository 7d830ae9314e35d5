"""Distance of returns to the surface that other scans show."""

import numpy as np

from benchmarks.lean.rigidity import surface_distance_m


def test_distance_to_a_surface_is_that_to_its_plane_and_unknown_where_nothing_was_seen():
    random = np.random.default_rng(0)
    seen = np.concatenate([random.uniform(-1, 1, (4000, 2)), random.normal(0, 1e-4, (4000, 1))], axis=1)
    asked = np.array([[0.0, 0.0, 0.03], [0.2, -0.3, 0.0], [0.0, 0.0, 2.0]])
    found = surface_distance_m(asked, seen)
    np.testing.assert_allclose(found[:2], [0.03, 0.0], atol=2e-3)
    assert np.isnan(found[2])
