"""Places that images prove: as many views as it takes, and no ray that looks through them."""

import numpy as np

from nvsf_core.evidence.image_surfels import DepthRays, image_surfels
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.simulation.ray_renderers import image_renderer

WALL_X_M = 10.0
FAR_M = 80.0


def a_view(y_m: float, *, is_proven: bool = True) -> DepthRays:
    """A wall 10 m ahead as a view beside the middle has it; without proof every ray goes on."""
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.1), np.arange(1.0, 3.0, 0.1))
    ray = np.stack([np.full(y.size, WALL_X_M), y.ravel() - y_m, z.ravel()], axis=1)
    range_m = np.linalg.norm(ray, axis=1)
    found = np.where(is_proven, range_m, np.inf)
    origin_m = np.array([0.0, y_m, 0.0], np.float32)
    return DepthRays(origin_m, (ray / range_m[:, None]).astype(np.float32), found.astype(np.float32))


def surfels_of(*views: DepthRays) -> Surfels | None:
    return image_surfels(views, far_m=FAR_M, intensity=0.3)


def answers_of(surfels: Surfels):
    ray = np.array([[WALL_X_M, 0.0, 1.5], [WALL_X_M, 0.55, 2.05], [0.0, 0.0, 1.0]])
    direction = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)
    render = image_renderer(surfels, most=24, far_m=FAR_M)
    return render(np.zeros((3, 3), np.float32), direction, np.zeros(3, np.float32), np.zeros(3))


def test_three_views_prove_a_wall_that_another_ray_then_meets() -> None:
    surfels = surfels_of(a_view(-1.0), a_view(0.0), a_view(1.0))
    assert surfels is not None
    found = answers_of(surfels)
    x_m = found.range_m[:2] * np.array([WALL_X_M / np.hypot(WALL_X_M, 1.5), 0.978])
    assert np.abs(x_m - WALL_X_M).max() < 0.05
    assert (found.hit[:2] > 0.9).all() and np.allclose(found.intensity[:2], 0.3)
    assert np.isinf(found.range_m[2]) and found.hit[2] == 0.0


def test_two_views_prove_nothing_however_many_pixels_they_have() -> None:
    assert surfels_of(a_view(-1.0), a_view(1.0)) is None
    assert surfels_of() is None
    assert surfels_of(*(a_view(y, is_proven=False) for y in (-1.0, 0.0, 1.0))) is None


def test_what_most_views_look_through_hardly_stops_a_ray() -> None:
    seen = [a_view(y) for y in (-1.0, 0.0, 1.0)]
    through = [a_view(y, is_proven=False) for y in np.linspace(-1.5, 1.5, 12)]
    surfels = surfels_of(*seen, *through)
    assert surfels is not None
    assert (answers_of(surfels).hit[:2] < 0.5).all()
