"""Laws of the ground's height map."""

import numpy as np

from nvsf_core.evidence.moving.visibility import build_ground


def road(generator: np.random.Generator) -> np.ndarray:
    """A road of 60 m x 60 m that rises by 3 m, twenty returns a cell."""
    flat = generator.uniform(0.0, 60.0, (72000, 2))
    height = 0.05 * flat[:, 0] + generator.normal(0.0, 0.01, len(flat))
    return np.column_stack([flat, height]).astype(np.float32)


def test_mirror_images_below_a_road_do_not_pull_it_down() -> None:
    generator = np.random.default_rng(0)
    points = road(generator)
    place = generator.uniform(24.0, 36.0, (25, 2))
    mirrored = np.repeat(np.column_stack([place, 0.05 * place[:, 0] - 8.0]), 5, axis=0).astype(np.float32)
    height = build_ground(np.concatenate([points, mirrored])).above(points)
    assert np.abs(height).max() < 0.5


def test_what_stands_on_a_slope_is_above_it() -> None:
    points = road(np.random.default_rng(1))
    wall = np.array(
        [[30.2, 20.0 + 0.1 * k, 1.5 + 0.1 * j] for k in range(40) for j in range(5, 20)], np.float32
    )
    height = build_ground(np.concatenate([points, wall])).above(wall)
    assert height.min() > 0.25


def test_a_drive_of_some_square_kilometres_has_ground_everywhere() -> None:
    # Diagonally through three kilometres of hills; one metre cells of all of it would be 9 million.
    generator = np.random.default_rng(2)
    along = generator.uniform(0.0, 3000.0, 200_000)
    beside = generator.uniform(-4.0, 4.0, 200_000)
    height = 8.0 * np.sin(along / 400.0)
    points = np.column_stack([along + beside, along - beside, height]).astype(np.float32)
    ground = build_ground(points)
    assert ground.height_m.size < 5_000_000
    assert np.quantile(np.abs(ground.above(points)), 0.98) < 0.5
