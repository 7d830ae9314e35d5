"""Scans for sensor tests: simulated ones with known lasers, and the real drives where they are at hand."""

import numpy as np
import pytest

from nvsf_core.sensors.beam_table import sensor_rays, wrap_angle
from nvsf_core.sensors.tables import LaserTable
from tests.conftest import SHARED

_DATA = SHARED / "data"


def _real_scans(scene: str, step: int) -> list[np.ndarray]:
    """Every `step`-th scan (N, 4) of a real drive; skips the test where it is absent."""
    paths = sorted((_DATA / scene).glob("data_3d_raw/*/velodyne_points/data/*.bin"))[::step]
    if not paths:
        pytest.skip(f"{_DATA / scene} is not on this machine")
    return [np.fromfile(path, "<f4").reshape(-1, 4) for path in paths]


def _simulated_scan(
    table: LaserTable, lasers: np.ndarray, firings: int, seed: int = 0, keep: float = 0.9
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scan in file order, points (N, 3) float32, with the laser (N,) and firing (N,) of each return."""
    rng = np.random.default_rng(seed)
    # Firings at encoder steps, counted from +180 degrees downwards.
    columns = np.rint((np.arange(firings) + 0.3) * table.lattice_steps / firings).astype(int)
    parts = []
    for laser in lasers:
        kept = np.flatnonzero(rng.random(firings) < keep)
        column = table.lattice_steps // 2 - columns[kept] - table.firing_shift_steps[laser]
        theta = wrap_angle((column + table.phase_steps[laser]) * table.step_rad)
        origin, direction = sensor_rays(table, theta, np.full(len(kept), laser))
        points = origin + rng.uniform(3.0, 60.0, len(kept))[:, None] * direction
        order = np.argsort(np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi))
        parts.append((points[order], np.full(len(kept), laser), kept[order]))
    points, laser, firing = (np.concatenate(column) for column in zip(*parts, strict=True))
    return points.astype(np.float32), laser, firing


@pytest.fixture(scope="session")
def real_scans():
    return _real_scans


@pytest.fixture(scope="session")
def simulated_scan():
    return _simulated_scan
