"""Laws of the truth that a view's guessed pixels are compared with."""

import numpy as np

from benchmarks.views.known_pixels import TrueCamera
from nvsf_core.demo.cameras import demo_camera
from nvsf_core.demo.world import DemoWorld
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import transform_points

CAMERA = Pinhole(fx=40.0, fy=40.0, cx=47.5, cy=18.0, width=96, height=36)


def test_an_image_shows_its_own_surfaces_and_none_behind_them_or_outside_of_it() -> None:
    world = DemoWorld()
    looking = demo_camera("image_00", 96, 36).camera_to_pose
    place = world.lidar_to_world(np.zeros(1))[0] @ looking
    one = TrueCamera(world, CAMERA, place[None], np.zeros(1))
    surface, _, is_sky = one.surface(place, 0.0)
    assert 0.1 < is_sky.mean() < 0.3
    distance_m = np.linalg.norm(surface, axis=2)
    np.testing.assert_allclose(distance_m[is_sky], 300.0, rtol=1e-5)
    assert distance_m[~is_sky].max() < 299.0
    own = transform_points(place, surface.reshape(-1, 3)).reshape(surface.shape)
    assert one.shows(own).mean() > 0.98
    near = surface[..., 2] < 50.0
    behind = transform_points(place, 1.3 * surface.reshape(-1, 3) + [0, 0, 0.5]).reshape(surface.shape)
    assert near.any() and one.shows(behind)[near].mean() < 0.1
    aside = transform_points(place, surface.reshape(-1, 3) * [-1.0, 1.0, -1.0]).reshape(surface.shape)
    assert not one.shows(aside).any()
