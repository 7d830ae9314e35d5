"""Depth maps get the edges of their images, on a street of two walls that is known exactly."""

import numpy as np
import torch
from scipy.ndimage import binary_dilation

from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.lidar_view import LidarView
from nvsf_core.rendering.sharp_depths import agreed, sharpened, static_sources

CAMERA = Pinhole(fx=80.0, fy=80.0, cx=63.5, cy=31.5, width=128, height=64)
NEAR_M, FAR_M = 4.0, 16.0
NO_LIDAR = LidarView(
    torch.full((64, 128), 1.0 / 300.0), torch.full((64, 128), torch.inf), torch.zeros(64, 128).byte()
)


def pose(right_m: float) -> np.ndarray:
    found = np.eye(4)
    found[0, 3] = right_m
    return found


def texture(x: np.ndarray, y: np.ndarray, scale: float, colours: tuple[float, ...]) -> np.ndarray:
    waves = np.sin(scale * x + 0.3) * np.cos(0.8 * scale * y) + np.sin(0.5 * scale * x + scale * y)
    return np.stack([colour + 0.08 * waves for colour in colours], axis=-1)


def photograph(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) and inverse depth (H, W) of a disc before a wall."""
    rays = CAMERA.rays(CAMERA.pixels())
    rays = rays / rays[..., 2:]
    near, far = (rays * depth_m + place[:3, 3] for depth_m in (NEAR_M, FAR_M))
    on_disc = np.hypot(near[..., 0], near[..., 1]) < 1.0
    wall = texture(far[..., 0], far[..., 1], 2.0, (0.3, 0.4, 0.7))
    disc = texture(near[..., 0], near[..., 1], 9.0, (0.8, 0.6, 0.2))
    return np.where(on_disc[..., None], disc, wall), np.where(on_disc, 1.0 / NEAR_M, 1.0 / FAR_M)


def seen(places_m: list[float]) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """Images (j, 5, H, W) as sources, their exact depth maps (j, H, W), and their poses (j, 4, 4)."""
    poses = np.stack([pose(x) for x in places_m])
    colours, inverse = zip(*(photograph(one) for one in poses), strict=True)
    images = torch.zeros(len(poses), 5, 64, 128)
    images[:, :3] = torch.from_numpy(np.stack(colours)).permute(0, 3, 1, 2)
    images[:, 3] = 1.0
    return images, np.stack(inverse).astype(np.float32), poses


def own_of(images: torch.Tensor) -> np.ndarray:
    """The first image (H, W, c), whose depths are sought."""
    return np.ascontiguousarray(images[0].permute(1, 2, 0).numpy())


def test_a_disc_that_is_too_wide_shrinks_to_its_edge_in_the_image() -> None:
    images, maps, poses = seen([0.0, 0.6, -0.6, 1.2, -1.2])
    truth = maps[0]
    wide = np.where(binary_dilation(truth > 0.1, iterations=3), truth.max(), truth.min()).astype(np.float32)
    sources = static_sources(images, [1, 2, 3, 4], poses, 0)
    found = sharpened(wide, own_of(images), NO_LIDAR, sources, CAMERA)
    wrong_before, wrong = np.count_nonzero(wide != truth), np.count_nonzero(found != truth)
    assert wrong_before > 250
    assert wrong < 0.25 * wrong_before
    # Right depths stay.
    right = sharpened(truth, own_of(images), NO_LIDAR, sources, CAMERA)
    np.testing.assert_array_equal(right[:20], truth[:20])


def test_unknown_pixels_get_a_surface_from_around_or_stay_unknown() -> None:
    images, maps, poses = seen([0.0, 0.6, -0.6])
    holes = maps[0].copy()
    holes[30, 20], holes[:, 100:] = 0.0, 0.0
    found = sharpened(holes, own_of(images), NO_LIDAR, static_sources(images, [1, 2], poses, 0), CAMERA)
    assert found[30, 20] == maps[0][30, 20]
    assert (found[:, 110:] == 0.0).all()


def test_a_return_offers_a_depth_that_the_map_lacks() -> None:
    images, maps, poses = seen([0.0, 0.6, -0.6, 1.2, -1.2])
    flat = np.full_like(maps[0], maps[0].min())
    returns = LidarView(torch.from_numpy(maps[0]), torch.zeros(64, 128), NO_LIDAR.label)
    found = sharpened(flat, own_of(images), returns, static_sources(images, [1, 2, 3, 4], poses, 0), CAMERA)
    on_disc = maps[0] > 0.1
    assert (found == maps[0])[on_disc].mean() > 0.9


def test_maps_of_the_same_street_agree_and_a_wrong_patch_is_marked() -> None:
    _, maps, poses = seen([0.0, 0.6, -0.6])
    wrong = maps[0].copy()
    wrong[5:15, 55:70] = 0.15
    static = np.ones(wrong.shape, np.bool_)
    found = agreed(wrong, 0, [1, 2], maps, poses, static, CAMERA)
    assert (found[5:15, 55:70] == -wrong[5:15, 55:70]).all()
    rest = np.ones_like(static)
    rest[5:15, 55:70] = False
    assert (found == wrong)[rest].mean() > 0.98
