"""What is random in a scan: which rays return, and the noise of their ranges."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.errors import DataError

RANGE_NOISE_M = 0.015
"""Standard deviation of the range noise; an HDL-64E's maker states below 2 cm (one sigma)."""
DRAW_SHARPNESS = 3.0
"""How far hit probabilities are pushed to 0 and 1 before drawing: lasers drop patches, not single rays."""
GRID_ARRAYS = ("grid_range_m", "grid_hit", "grid_intensity", "grid_azimuth_rad", "grid_elevation_rad")
"""Arrays of a rendered turn that a scan is drawn from, each (lasers, firings)."""


def sharpen_hits(probability: np.ndarray, sharpness: float = DRAW_SHARPNESS) -> np.ndarray:
    """Push probabilities towards 0 and 1 while their sum stays: q = sigmoid(sharpness logit(p) + b).

    Args:
        probability: Any shape, 0..1.
        sharpness: 1 leaves them as they are.

    Returns:
        The same shape, float64; b is found by bisection so that the expected number of hits is kept.
    """
    p = np.clip(probability.astype(np.float64), 1e-6, 1.0 - 1e-6)
    if p.size == 0:
        return p
    logit = sharpness * (np.log(p) - np.log1p(-p))
    low, high = -50.0, 50.0
    for _ in range(40):
        shift = 0.5 * (low + high)
        expected = np.mean(1.0 / (1.0 + np.exp(-np.clip(logit + shift, -60.0, 60.0))))
        low, high = (shift, high) if expected < p.mean() else (low, shift)
    sharpened: np.ndarray = 1.0 / (1.0 + np.exp(-np.clip(logit + 0.5 * (low + high), -60.0, 60.0)))
    return sharpened


def draw_scan(
    grid: Mapping[str, np.ndarray], generator: np.random.Generator, range_noise_m: float = RANGE_NOISE_M
) -> np.ndarray:
    """Draw one scan of a rendered grid.

    Args:
        grid: `grid_*` of one turn, each (lasers, firings): range (metres, inf = nothing there), hit
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
                f"draw_scan: {broken} of {grid[name].size} values of {name} are NaN; the model that rendered "
                "them has diverged: train it again"
            )
    range_m = grid["grid_range_m"].astype(np.float64)
    kept = generator.random(range_m.shape) < sharpen_hits(grid["grid_hit"])
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
    drawn: np.ndarray = np.take_along_axis(scan, order[..., None], 1)[np.take_along_axis(kept, order, 1)]
    return drawn
