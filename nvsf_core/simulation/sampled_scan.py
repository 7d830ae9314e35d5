"""A scan sampled from a rendered sweep: which rays return, and the noise of their ranges."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.simulation.raydrop import sample_returns

RANGE_NOISE_M = 0.015
"""Standard deviation of the range noise; an HDL-64E's maker states below 2 cm (one sigma)."""
GRID_ARRAYS = ("grid_range_m", "grid_hit", "grid_intensity", "grid_azimuth_rad", "grid_elevation_rad")
"""Arrays of a rendered sweep that a scan is sampled from, each (lasers, firings)."""


def sample_scan(
    grid: Mapping[str, np.ndarray], generator: np.random.Generator, range_noise_m: float = RANGE_NOISE_M
) -> np.ndarray:
    """Sample one scan of a rendered sweep.

    Args:
        grid: `grid_*` of one sweep, each (lasers, firings): range (metres, inf = nothing there), hit
            probability, intensity 0..1, azimuth and elevation in the sensor's frame at firing time.
        generator: What is random comes from here.
        range_noise_m: Standard deviation of the range.

    Returns:
        (N, 4) float32 x, y, z, intensity: laser by laser from the top, azimuth ascending in [0, 360) degrees.

    Raises:
        DataError: An array of the grid holds NaN; as a hit it would silently be a drop.
    """
    for name in GRID_ARRAYS:
        broken = int(np.count_nonzero(np.isnan(grid[name])))
        if broken:
            raise DataError(
                f"sample_scan: {broken} of {grid[name].size} values of {name} are NaN; the model that "
                "rendered them has diverged: train it again"
            )
    range_m = grid["grid_range_m"].astype(np.float64)
    kept = sample_returns(grid["grid_hit"], generator)
    noise_m = generator.normal(0.0, range_noise_m, range_m.shape)
    kept &= np.isfinite(range_m) & (range_m > 0.0)
    noisy_m = np.maximum(np.where(kept, range_m, 1.0) + noise_m, 0.01)
    azimuth, elevation = (grid[f"grid_{name}_rad"].astype(np.float64) for name in ("azimuth", "elevation"))
    level_m = noisy_m * np.cos(elevation)
    scan = np.stack(
        [
            level_m * np.cos(azimuth),
            level_m * np.sin(azimuth),
            noisy_m * np.sin(elevation),
            np.clip(grid["grid_intensity"], 0.0, 1.0),
        ],
        axis=-1,
    ).astype(np.float32)
    order = np.argsort(np.mod(azimuth, 2.0 * np.pi), axis=1, kind="stable")
    sampled: np.ndarray = np.take_along_axis(scan, order[..., None], 1)[np.take_along_axis(kept, order, 1)]
    return sampled
