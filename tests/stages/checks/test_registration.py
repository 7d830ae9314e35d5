"""Poses are checked against the scans."""

import numpy as np
import pytest

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.errors import MissingLibraryError
from nvsf_core.stages.checks.registration import order_check, registration_check, upright_check


def street(shift_m: float) -> dict[str, np.ndarray]:
    """Two scans of a street corner, the second wrongly moved to the side and forward."""
    draws = np.random.default_rng(0)
    ground = np.stack([draws.uniform(-20, 20, 6000), draws.uniform(-8, 8, 6000), np.full(6000, -1.7)], axis=1)
    wall = np.stack([draws.uniform(-20, 20, 6000), np.full(6000, 8.0), draws.uniform(-1.7, 5, 6000)], axis=1)
    front = np.stack([np.full(3000, 18.0), draws.uniform(-8, 8, 3000), draws.uniform(-1.7, 5, 3000)], axis=1)
    points = np.concatenate([ground, wall, front]).astype(np.float32)
    scans = np.concatenate([points, points + np.float32([shift_m, shift_m, 0.0])])
    range_m = np.linalg.norm(scans, axis=1)
    return {
        "frame": np.arange(2),
        "offsets": np.array([0, len(points), 2 * len(points)]),
        "origin_m": np.zeros_like(scans),
        "direction": scans / range_m[:, None],
        "range_m": range_m,
        "is_own_vehicle": np.zeros(len(scans), bool),
    }


def tunnel(shift_m: tuple[float, float, float]) -> dict[str, np.ndarray]:
    """Two scans, 1 m apart along a straight tunnel 6 m wide and 5 m high; the second's pose is wrong."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 500), np.radians(np.linspace(-25, 3, 48)))
    flat = np.cos(elevation.ravel())
    direction = np.stack(
        [flat * np.cos(azimuth.ravel()), flat * np.sin(azimuth.ravel()), np.sin(elevation.ravel())], axis=-1
    )
    side_m, up_m = 3.0 / np.abs(direction[:, 1]), np.where(direction[:, 2] < 0.0, 1.7, 3.3)
    met_m = np.minimum(side_m, up_m / np.abs(direction[:, 2]))
    direction, met_m = direction[met_m < 79.0], met_m[met_m < 79.0]
    noise_m = np.random.default_rng(0).normal(0.0, 0.01, (2, len(met_m)))
    begin_m = np.array([[0.0, 0.0, 0.0], np.add((1.0, 0.0, 0.0), shift_m)])
    return {
        "frame": np.array([7, 8]),
        "offsets": np.arange(3) * len(met_m),
        "origin_m": np.repeat(begin_m, len(met_m), axis=0),
        "direction": np.tile(direction, (2, 1)),
        "range_m": (met_m + noise_m).ravel(),
        "is_own_vehicle": np.zeros(2 * len(met_m), bool),
    }


def hall(
    half_length_m: float, scan_at: list[int], ceiling_m: float = 3.3
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Six scans, 1 m apart along a hall 6 m wide, floor 1.7 m below and ceiling above them, and their poses;
    `scan_at` says where each was measured, in poses.
    """
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 360), np.radians(np.linspace(-25, 15, 32)))
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    flat = np.cos(elevation)
    direction = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    half_m = np.where(direction > 0.0, [np.inf, 3.0, ceiling_m], [np.inf, 3.0, 1.7])
    range_m = []
    for k in scan_at:
        half_m[:, 0] = half_length_m - np.sign(direction[:, 0]) * (k - 2.5)
        range_m.append((half_m / np.maximum(np.abs(direction), 1e-9)).min(axis=1))
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6) - 2.5
    noise_m = np.random.default_rng(0).normal(0.0, 0.01, 6 * len(azimuth))
    arrays = {
        "frame": np.arange(20, 26),
        "offsets": np.arange(7) * len(azimuth),
        "origin_m": np.repeat(poses[:, :3, 3], len(azimuth), axis=0),
        "direction": np.tile(direction, (6, 1)),
        "range_m": np.concatenate(range_m) + noise_m,
        "is_own_vehicle": np.zeros(6 * len(azimuth), bool),
    }
    return arrays, poses


def test_swapped_scans_are_found_and_named():
    assert order_check(*hall(12.0, [0, 1, 2, 3, 4, 5])).passed
    check = order_check(*hall(12.0, [0, 1, 3, 2, 4, 5]))
    assert not check.passed and check.value > 2.0 * check.limit
    assert "22, 23" in check.detail and "were files swapped" in check.detail
    assert "nothing can be said" not in check.detail


def test_where_all_scans_lie_wrong_poses_are_asked_about_and_not_files():
    check = order_check(*hall(12.0, [5, 4, 3, 2, 1, 0]))
    assert not check.passed and check.detail.startswith("6 of 6 scans lie better")
    assert "are all poses or their times wrong?" in check.detail and "swapped" not in check.detail


def test_scans_of_a_tunnel_are_not_blamed_for_rings_that_travel_with_the_sensor():
    check = order_check(*hall(np.inf, [0, 1, 2, 3, 4, 5]))
    assert check.passed
    assert check.detail.startswith("not run: of 6 scans nothing can be said: no surface there fixes the way")


def bend(radius_m: float, lasers: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Six scans, 0.9 m apart along the middle of a tunnel that bends, 10.7 m wide and 5 m high, all right."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 420, endpoint=False), np.radians(np.linspace(-22.5, 22.5, lasers))
    )
    flat, rise = np.cos(elevation.ravel()), np.sin(elevation.ravel())
    direction = np.stack([flat * np.cos(azimuth.ravel()), flat * np.sin(azimuth.ravel()), rise], axis=-1)
    # The bend's centre lies to the left, at (0, radius): walls are circles about it.
    ahead = -radius_m * direction[:, 1] / flat
    met_m = np.full((2, len(flat)), np.inf)
    for number, (wall_m, sign) in enumerate(((radius_m - 5.35, -1.0), (radius_m + 5.35, 1.0))):
        inside = ahead**2 - radius_m**2 + wall_m**2
        met_m[number] = np.where(inside > 0.0, -ahead + sign * np.sqrt(np.maximum(inside, 0.0)), np.inf)
    met_m[met_m <= 0.0] = np.inf
    side_m = met_m.min(axis=0) / flat
    range_m = np.minimum(side_m, np.where(rise < 0.0, 1.73, 3.27) / np.maximum(np.abs(rise), 1e-9))
    poses, placed = np.tile(np.eye(4), (6, 1, 1)), []
    for k, angle in enumerate(np.arange(6) * 0.9 / radius_m):
        poses[k, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        poses[k, :2, 3] = radius_m * np.array([np.sin(angle), 1.0 - np.cos(angle)])
        placed.append(direction @ poses[k, :3, :3].T)
    noise_m = np.random.default_rng(0).normal(0.0, 0.015, 6 * len(range_m))
    arrays = {
        "frame": np.arange(20, 26),
        "offsets": np.arange(7) * len(range_m),
        "origin_m": np.repeat(poses[:, :3, 3], len(range_m), axis=0),
        "direction": np.concatenate(placed),
        "range_m": np.tile(range_m, 6) + noise_m,
        "is_own_vehicle": np.zeros(6 * len(range_m), bool),
    }
    return arrays, poses


def test_scans_of_a_tunnel_that_bends_are_not_blamed_either():
    for lasers in (16, 32, 64):
        check = order_check(*bend(80.0, lasers))
        assert check.passed, check.detail


@pytest.mark.parametrize(
    ("lidar_tilt_deg", "world_tilt_deg", "passed"),
    [(0.0, 0.0, True), (30.0, 0.0, True), (0.0, 20.0, True), (30.0, 30.0, False)],
    ids=["level", "a tilted sensor", "a hill", "poses of a tilted sensor"],
)  # fmt: skip
def test_poses_of_a_tilted_sensors_frame_are_found_and_hills_are_not(lidar_tilt_deg, world_tilt_deg, passed):
    arrays, poses = hall(12.0, [0, 1, 2, 3, 4, 5])
    turns = []
    for angle_rad in np.radians([lidar_tilt_deg, world_tilt_deg]):
        cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
        turns.append(np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]]))
    of_lidar, of_world = turns
    arrays |= {name: arrays[name] @ of_world for name in ("origin_m", "direction")}
    poses[:, :3, 3] = poses[:, :3, 3] @ of_world
    poses[:, :3, :3] = of_world.T @ of_lidar
    # The world's x is the scene's y.
    scene_to_world = np.eye(4)[[1, 0, 2, 3]] * [[1], [-1], [1], [1]]
    check = upright_check(arrays, poses, scene_to_world)
    assert check.passed is passed and not check.blocking
    if not passed:
        assert check.value == pytest.approx(30.0, abs=1.0)
        assert "so that the normal, (0.00, 0.50, 0.87), becomes (0, 0, 1)" in check.detail


@pytest.mark.parametrize("turned", [[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]], ids=["about x", "about y"])
def test_a_drive_that_stands_upside_down_is_found(turned):
    arrays, poses = hall(12.0, [0, 1, 2, 3, 4, 5])
    arrays |= {name: arrays[name] * turned for name in ("origin_m", "direction")}
    poses[:, :3] *= np.array(turned)[:, None]
    check = upright_check(arrays, poses, np.eye(4))
    assert not check.passed and check.value == pytest.approx(180.0, abs=2.0)
    assert "upside down in the world; write quaternions as x, y, z, w" in check.detail


@pytest.mark.parametrize("axes", [[1.0, -1.0, -1.0], [1.0, 1.0, -1.0]], ids=["y right", "y left"])
def test_scans_whose_z_points_down_are_found(axes):
    arrays, poses = hall(12.0, [0, 1, 2, 3, 4, 5])
    arrays["direction"] = arrays["direction"] * axes
    check = upright_check(arrays, poses, np.eye(4))
    assert not check.passed and check.value == pytest.approx(180.0, abs=2.0)
    assert "the scans' z points down: write scans as x forward, y left, z up" in check.detail


def test_a_low_ceiling_above_the_lidar_is_not_taken_for_the_ground():
    for ceiling_m in (0.6, 1.7, 3.3):
        check = upright_check(*hall(12.0, [0, 1, 2, 3, 4, 5], ceiling_m), np.eye(4))
        assert check.passed and check.value < 2.0, check.detail


def test_without_ground_nothing_is_said_of_up():
    arrays, poses = hall(12.0, [0, 1, 2, 3, 4, 5])
    arrays["is_own_vehicle"] = arrays["direction"][:, 2] < 0.0
    assert upright_check(arrays, poses, np.eye(4)).detail.startswith("not run: ground is seen around 0 scans")


def _require_open3d() -> None:
    try:
        load_open3d()
    except MissingLibraryError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("shift_m", "passed"), [(0.0, True), (0.25, False)])
def test_a_wrong_pose_is_found(shift_m, passed):
    _require_open3d()
    check = registration_check(street(shift_m))
    assert check.passed is passed
    assert not check.blocking


def test_a_jump_of_the_poses_is_found_between_any_two_scans():
    _require_open3d()
    right = street(0.0)
    returns = right["offsets"][1]
    arrays = {name: np.tile(right[name][:returns], (6, 1)) for name in ("direction", "origin_m")}
    arrays |= {name: np.tile(right[name][:returns], 6) for name in ("range_m", "is_own_vehicle")}
    arrays |= {"frame": np.arange(10, 16), "offsets": np.arange(7) * returns}
    for later in range(1, 6):
        jumped_m = np.repeat(np.where(np.arange(6) >= later, 0.3, 0.0), returns)[:, None]
        check = registration_check(arrays | {"origin_m": arrays["origin_m"] + jumped_m * [1.0, 1.0, 0.0]})
        assert not check.passed and check.detail.startswith("5 pairs")
        assert check.detail.endswith(f"doubtful at frames {9 + later} and {10 + later}")


def test_right_poses_in_a_tunnel_are_not_blamed_for_what_no_wall_tells():
    _require_open3d()
    check = registration_check(tunnel((0.0, 0.0, 0.0)))
    assert check.passed and check.value < 0.05
    assert "of frames 7 and 8 nothing can be said along (1.00, 0.00, 0.00)" in check.detail
    assert "nothing can be said" not in registration_check(street(0.0)).detail


@pytest.mark.parametrize(
    "shift_m", [(0.0, 0.5, 0.0), (0.0, 0.0, 0.3), (50.0, 0.0, 0.0), (30.0, 40.0, 0.0)],
    ids=["sideways", "upwards", "50 m on", "50 m away"],
)  # fmt: skip
def test_wrong_poses_in_a_tunnel_are_found(shift_m):
    _require_open3d()
    check = registration_check(tunnel(shift_m))
    assert not check.passed and "doubtful at frames 7 and 8" in check.detail


def test_a_single_scan_has_no_neighbour():
    arrays = street(0.0)
    arrays["frame"] = arrays["frame"][:1]
    assert registration_check(arrays).detail.startswith("not run: no two neighbouring scans")


def test_the_frames_of_a_wrong_pose_are_named():
    _require_open3d()
    right, wrong = street(0.0), street(0.25)
    arrays = {name: np.concatenate([right[name], wrong[name]]) for name in ("direction", "range_m")}
    arrays |= {name: np.concatenate([right[name]] * 2) for name in ("origin_m", "is_own_vehicle")}
    returns = right["offsets"][1]
    arrays |= {"frame": np.array([10, 11, 12, 13]), "offsets": np.arange(5) * returns}
    check = registration_check(arrays)
    assert not check.passed and check.value > check.limit
    assert "doubtful at frames 12 and 13" in check.detail and "10 and 11" not in check.detail
