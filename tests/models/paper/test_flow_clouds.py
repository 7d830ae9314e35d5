"""Laws of the clouds that the flow is fitted to."""

import numpy as np
import pytest

from nvsf_core.errors import DataError, ShapeError
from nvsf_core.models.paper.flow_training import flow_cloud, is_ground, is_stray

HERE = np.eye(4)
ORIGIN = np.zeros(3)


def draws(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def street(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A sloped street 1.73 m below with a kerb, and a box like a car on it: points, whether ground."""
    n = 6000
    x, y = generator.uniform(-25.0, 25.0, n), generator.uniform(-10.0, 10.0, n)
    z = -1.73 + 0.02 * x + np.where(y > 4.0, 0.15, 0.0) + generator.normal(0.0, 0.02, n)
    side = generator.uniform(0.0, 1.0, (1500, 2))
    car = np.stack([8.0 + 4.0 * side[:, 0], np.full(1500, 2.0), -1.4 + 1.3 * side[:, 1]], axis=1)
    is_street = np.arange(n + 1500) < n
    return np.concatenate([np.stack([x, y, z], axis=1), car]), is_street


def test_ground_goes_and_the_car_stays() -> None:
    points, is_street = street(draws())
    ground = is_ground(points, draws())
    assert ground[is_street].mean() > 0.99
    # The car's sides begin 0.17 m over the street: only that edge may go with it.
    assert ground[~is_street].mean() < 0.1


def test_the_side_of_a_car_is_no_ground() -> None:
    side = draws().uniform(0.0, 1.0, (4000, 2))
    wall = np.stack([8.0 + 4.0 * side[:, 0], np.full(4000, 2.0), -2.0 + 2.0 * side[:, 1]], axis=1)
    both = np.concatenate([wall, wall[:, [1, 0, 2]]])
    assert not is_ground(both, draws()).any()


def test_a_cloud_without_ground_keeps_everything_in_reach() -> None:
    points = draws().uniform([-20.0, -20.0, 0.0], [20.0, 20.0, 3.0], (5000, 3))
    cloud = flow_cloud(points, HERE, ORIGIN, draws())
    assert len(cloud) > 4800


def test_reach_height_and_own_vehicle_are_cut_in_the_sensors_frame() -> None:
    # Nine points alike but for place: none is stray among its equals.
    in_sensor = np.array(
        [
            [0.0, 0.5, 0.0], [61.0, 0.0, 0.0], [5.0, 0.0, -2.6], [5.0, 0.0, 4.1], [1.9, 0.9, 0.0],
            [2.1, 0.0, 0.0], [0.0, 1.1, 0.0], [5.0, 0.0, 0.0], [60.0, 0.0, 0.0],
        ]
    )  # fmt: skip
    pose = np.array([[0, -1, 0, 100.0], [1, 0, 0, 200.0], [0, 0, 1, 5.0], [0, 0, 0, 1]])
    points = in_sensor @ pose[:3, :3].T + pose[:3, 3]
    cloud = flow_cloud(points, pose, pose[:3, 3], draws())
    assert np.allclose(cloud, in_sensor[5:] @ pose[:3, :3].T, atol=1e-5)
    assert cloud.dtype == np.float32


def test_stray_points_go_the_rest_stays_in_small_and_large_clouds() -> None:
    for n in (2000, 20_000):
        dense = draws().uniform(0.0, 5.0, (n, 3))
        strays = draws(1).uniform(20.0, 50.0, (10, 3))
        stray = is_stray(np.concatenate([dense, strays]), draws())
        assert stray[n:].all()
        assert stray[:n].mean() < 0.01


@pytest.mark.parametrize("n", [0, 1, 2, 3, 10, 64, 65])
def test_few_points_are_no_error(n: int) -> None:
    points = draws().uniform([-30.0, -10.0, -2.0], [30.0, 10.0, -1.2], (n, 3))
    assert flow_cloud(points, HERE, ORIGIN, draws()).shape[1] == 3


def test_narrow_flat_and_coinciding_clouds_end() -> None:
    line = np.stack([np.linspace(2.0, 50.0, 500), np.zeros(500), np.full(500, -1.7)], axis=1)
    for points in (line, np.tile([[5.0, 0.0, -1.7]], (500, 1))):
        assert len(flow_cloud(points, HERE, ORIGIN, draws())) <= 500


def test_the_same_generator_state_gives_the_same_cloud_far_from_the_origin_too() -> None:
    points, _ = street(draws())
    far = np.array([4000.0, -3000.0, 100.0])
    pose = HERE.copy()
    pose[:3, 3] = far
    near = flow_cloud(points, HERE, ORIGIN, draws(3))
    assert np.array_equal(near, flow_cloud(points, HERE, ORIGIN, draws(3)))
    moved = flow_cloud(points + far, pose, far, draws(3))
    assert np.allclose(moved, near, atol=1e-5)


def test_what_is_no_cloud_is_refused() -> None:
    with pytest.raises(ShapeError):
        flow_cloud(np.zeros((3, 4)), HERE, ORIGIN, draws())
    with pytest.raises(DataError, match="1 of 2"):
        flow_cloud(np.array([[1.0, np.nan, 0.0], [1.0, 2.0, 3.0]]), HERE, ORIGIN, draws())
