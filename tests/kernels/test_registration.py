"""Laws of the small solver inside registration."""

import numpy as np

from nvsf_core.kernels.registration import _solve


def test_positive_definite_systems_are_solved_as_numpy_does() -> None:
    rng = np.random.default_rng(0)
    for spread in np.geomspace(1.0, 1e3, 200):
        half = rng.normal(size=(4, 7)) * np.geomspace(1.0, spread, 4)[:, None]
        system, right = half @ half.T + 0.01 * np.eye(4), rng.normal(size=4)
        expected = np.linalg.solve(system, right)
        found = _solve(system.copy(), right.copy())
        assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()
