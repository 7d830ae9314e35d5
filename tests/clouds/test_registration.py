"""Registration tells what surfaces tell, and says where they do not."""

import numpy as np
import pytest

from nvsf_core.clouds.registration import LEAST_ACROSS, register, slippage
from nvsf_core.geometry.se3 import exp_so3


def _box(draws: np.random.Generator, half_m: tuple[float, float, float], sides: str) -> np.ndarray:
    """Points (n, 3) on sides of a box, their normals beside them (n, 6)."""
    parts = []
    for axis in ("xyz".index(side) for side in sides):
        points = draws.uniform(-1.0, 1.0, (2000, 3)) * half_m
        points[:, axis] = np.sign(points[:, axis]) * half_m[axis]
        parts.append(np.concatenate([points, np.tile(np.eye(3)[axis], (len(points), 1))], axis=1))
    return np.concatenate(parts)


@pytest.mark.usefixtures("open3d")
def test_a_known_motion_is_found() -> None:
    target_m = _box(np.random.default_rng(1), (10.0, 10.0, 5.0), "xyz")[:, :3]
    turn = exp_so3(np.array([0.0, 0.0, np.radians(0.8)]))
    found = register(target_m @ turn.T + np.array([0.2, 0.1, 0.05]), target_m)
    assert abs(found.shift_m - np.linalg.norm([0.2, 0.1, 0.05])) < 0.02
    assert abs(found.turn_deg - 0.8) < 0.02
    assert found.matched > 0.9
    assert len(found.free_shifts) == len(found.free_turns) == 0


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("noise_m", [0.0, 0.02])
def test_a_plane_tells_its_height_and_its_slope_alone(noise_m: float) -> None:
    draws = np.random.default_rng(2)
    plane_m = draws.uniform(-20.0, 20.0, (4000, 3)) * (1.0, 1.0, 0.0)
    lifted = plane_m + np.array([0.4, -0.3, 0.2]) + draws.normal(0.0, noise_m, plane_m.shape)
    found = register(lifted, plane_m)
    assert abs(found.shift_m - 0.2) < 0.01
    assert found.turn_deg < 0.1
    np.testing.assert_allclose(np.abs(found.free_shifts[:, 2]), 0.0, atol=0.02)
    np.testing.assert_allclose(found.free_turns, [[0.0, 0.0, 1.0]], atol=0.02)


@pytest.mark.usefixtures("open3d")
def test_clouds_that_nowhere_meet_match_nothing() -> None:
    target_m = _box(np.random.default_rng(3), (2.0, 2.0, 2.0), "xyz")[:, :3]
    found = register(target_m + 100.0, target_m)
    assert (found.matched, found.shift_m, found.turn_deg) == (0.0, 0.0, 0.0)
    assert len(found.free_shifts) == len(found.free_turns) == 3


@pytest.mark.parametrize(
    ("sides", "shifts", "turns"), [("xyz", 0, 0), ("yz", 1, 0), ("z", 2, 1)], ids=["room", "tunnel", "floor"]
)
def test_free_motions_turn_with_the_world(sides: str, shifts: int, turns: int) -> None:
    draws = np.random.default_rng(4)
    made = _box(draws, (20.0, 3.0, 2.0), sides)
    turn = exp_so3(draws.normal(size=3))
    found = slippage(made[:, :3] @ turn.T + (1e3, -2e3, 50.0), made[:, 3:] @ turn.T)
    assert (len(found.free_shifts), len(found.free_turns)) == (shifts, turns)
    across = {"yz": [1, 2], "z": [2]}.get(sides, [])
    np.testing.assert_allclose((found.free_shifts @ turn)[:, across], 0.0, atol=1e-6)
    upright = np.tile([0.0, 0.0, 1.0], (turns, 1))
    np.testing.assert_allclose(np.abs(found.free_turns @ turn), upright, atol=1e-6)


def test_a_round_tunnel_turns_about_its_own_axis() -> None:
    draws = np.random.default_rng(5)
    along_m, angle = draws.uniform(-20.0, 20.0, 5000), draws.uniform(-2.5, 2.0, 5000)
    normals = np.stack([np.zeros(5000), np.cos(angle), np.sin(angle)], axis=1)
    found = slippage(np.stack([along_m, *(3.0 * normals.T[1:])], axis=1), normals)
    np.testing.assert_allclose(found.free_shifts, [[1.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(found.free_turns, [[1.0, 0.0, 0.0]], atol=0.01)


def test_what_is_told_is_the_share_across_the_surfaces() -> None:
    draws = np.random.default_rng(6)
    made = _box(draws, (20.0, 3.0, 2.0), "yz")
    found = slippage(made[:, :3], made[:, 3:])
    for motion in found.resisted.T:
        turned = np.cross(found.axes @ (motion[:3] / found.lever_m), made[:, :3] - made[:, :3].mean(axis=0))
        moved = turned + motion[3:]
        assert np.mean(moved**2) * 3.0 == pytest.approx(1.0)
        assert np.mean(np.sum(moved * made[:, 3:], axis=1) ** 2) >= LEAST_ACROSS
    assert found.determined(np.zeros(3), np.array([0.5, 0.0, 0.0]))[0] < 0.02
    assert found.determined(np.zeros(3), np.array([0.5, 0.4, 0.0]))[0] == pytest.approx(0.4, abs=0.02)
