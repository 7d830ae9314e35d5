"""Rotations by about 0 and 180 degrees, also during a sweep; camera rays at 90 degrees and beyond."""

import math

import mpmath
import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, largest, refused
from benchmarks.numerics.cases.tolerances import LENGTH_M
from nvsf_core.errors import DataError
from nvsf_core.geometry.boxes import inside_any
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.geometry.se3 import exp_se3, exp_so3, log_se3, log_so3
from nvsf_core.rendering.scaled_rays import leave_box
from nvsf_core.sensors.beam_table import wrap_angle
from nvsf_core.sensors.sweep import Trajectory, sweep_fraction

TITLE = "Poses and cameras"
_NEARLY_PI = math.pi - 1e-6
_ANGLES = (
    0.0, 1e-300, 1e-160, 1e-16, 1e-12, 1e-9, 1e-6, 9.99e-4, 1e-3, 1.001e-3, 0.01, 0.5, 1.0, 2.0, 3.0, 3.14,
    _NEARLY_PI, math.pi - 1e-9, math.pi - 1e-12, math.pi,
)  # fmt: skip
KITTI_360 = MeiFisheye(
    xi=2.2134, k1=0.016798, k2=1.6548, p1=4.2223e-4, p2=4.2462e-4, gamma1=1336.3, gamma2=1335.8,
    u0=716.94, v0=705.76, width=1400, height=1400,
)  # fmt: skip
"""KITTI-360's image_02, rounded."""
_CAMERA = Pinhole(fx=552.55, fy=552.55, cx=682.05, cy=238.77, width=1408, height=376)
_RANDOM = np.random.default_rng(0).normal(size=(6, 3))
_AXES = np.concatenate([np.eye(3), -np.eye(3), _RANDOM / np.linalg.norm(_RANDOM, axis=1)[:, None]])
_TWISTS = [np.array([1.2, -0.3, 0.1, *(axis * angle)]) for axis in _AXES for angle in _ANGLES]


def _exact_motion(twist: np.ndarray, share: float = 1.0) -> np.ndarray:
    """The matrix exponential of share x twist by mpmath's Taylor series, 40 digits."""
    with mpmath.workdps(40):
        x, y, z, a, b, c = (mpmath.mpf(float(v)) * mpmath.mpf(share) for v in twist)
        matrix = mpmath.matrix([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0] * 4])
        return np.array(mpmath.expm(matrix, method="taylor").tolist(), dtype=np.float64)


def _logarithm() -> float:
    """Angle and axis themselves; nearer to 180 degrees the axis is ill-conditioned."""
    away = [twist for twist in _TWISTS if np.linalg.norm(twist[3:]) < math.pi - 1e-7]
    return max(largest(log_se3(exp_se3(twist)), twist) for twist in away)


def _tiny_angles() -> float:
    axis, angles = np.array([0.6, 0.0, 0.8]), np.geomspace(1e-300, 1e-3, 200)
    return max(largest(log_so3(exp_so3(axis * angle)) / angle, axis) for angle in angles)


def _sweep(angle: float) -> float:
    """Rays of a sweep whose sensor turns by some angle from frame to frame, against the exact motion."""
    worst, shares = 0.0, np.linspace(0.0, 1.0, 9)
    origin, direction = np.tile([0.0, 0.0, 0.2], (9, 1)), np.tile([0.6, 0.0, 0.8], (9, 1))
    for axis in _AXES:
        twist = np.array([1.2, -0.3, 0.1, *(axis * angle)])
        # At 180 degrees the way round is not in the poses: the reference takes the one that was chosen.
        chosen = log_se3(exp_se3(twist)) if angle > math.pi - 1e-5 else twist
        trajectory = Trajectory(np.array([0.0, 0.1]), np.stack([np.eye(4), exp_se3(twist)]), np.eye(4))
        start, towards = trajectory.move_rays(origin, direction, shares * 0.1)
        motions = np.stack([_exact_motion(chosen, float(share)) for share in shares])
        ends = np.einsum("nij,nj->ni", motions[:, :3, :3], origin + 80.0 * direction) + motions[:, :3, 3]
        worst = max(worst, largest(start + 80.0 * towards, ends))
    return worst


def _wrap() -> float:
    multiples = np.arange(-9, 10) * np.pi
    around = [np.nextafter(multiples, side) for side in (-np.inf, np.inf)]
    angles = np.concatenate([multiples, *around, [0.0, -0.0, 1e-300, -1e-300], np.linspace(-50, 50, 4001)])
    wrapped, fraction = wrap_angle(angles), sweep_fraction(angles)
    assert bool(((wrapped > -np.pi) & (wrapped <= np.pi)).all()), "outside (-pi, pi]"
    assert bool(((fraction >= -0.5) & (fraction < 0.5)).all()), "outside [-1/2, 1/2)"
    turns = (angles - wrapped) / (2 * np.pi)
    return largest(turns, np.rint(turns))


def _poses(times_s: np.ndarray, first_x_m: float = 0.0) -> Trajectory:
    poses = np.stack([np.eye(4)] * len(times_s))
    poses[0, 0, 3] = first_x_m
    return Trajectory(times_s, poses, np.eye(4))


def _exact_pixel(camera: MeiFisheye, point: np.ndarray) -> tuple[float, float]:
    """Mei and Rives' model in 40 digits."""
    with mpmath.workdps(40):
        x, y, z = (mpmath.mpf(float(v)) for v in point)
        length = mpmath.sqrt(x * x + y * y + z * z)
        mx, my = (v / length / (z / length + camera.xi) for v in (x, y))
        r2 = mx * mx + my * my
        radial = 1 + camera.k1 * r2 + camera.k2 * r2 * r2
        dx = mx * radial + 2 * camera.p1 * mx * my + camera.p2 * (r2 + 2 * mx * mx)
        dy = my * radial + camera.p1 * (r2 + 2 * my * my) + 2 * camera.p2 * mx * my
        return float(camera.gamma1 * dx + camera.u0), float(camera.gamma2 * dy + camera.v0)


def _directions(*angles_deg: float) -> np.ndarray:
    """Directions at angles from the optical axis, round the clock."""
    turn = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    angle, around = (a.ravel() for a in np.meshgrid(np.deg2rad(angles_deg), turn))
    return np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)


def _project() -> float:
    near = _directions(0.0, 1e-9, 1e-3, 45, 89.999, 90.0, 90.001, 95, 100, 110, 116.8)
    points = np.concatenate([near * 1e-3, near, near * 1e4])
    return largest(
        KITTI_360.project(points)[0], np.array([_exact_pixel(KITTI_360, point) for point in points])
    )


def _beyond() -> str:
    """Past cos = -1/xi the model folds back."""
    edge_deg = math.degrees(math.acos(-1.0 / KITTI_360.xi))
    points = np.concatenate([_directions(edge_deg + 0.01, 150.0, 179.99, 180.0), np.zeros((1, 3))])
    pixels, inside = KITTI_360.project(points)
    assert bool(np.isnan(pixels).all()) and not inside.any(), "an image of what is not seen"
    return f"no image beyond {edge_deg:.2f} degrees, nor of the centre"


def _pinhole() -> float:
    """Beside, behind and on the camera: never inside, NaN behind; in front it inverts."""
    points = np.array([[1, 1, 0.0], [1, 1, -0.0], [0, 0, 0], [1, 1, -5], [0, 0, -1e-300], [1e3, 0, 1e-9]])
    pixels, inside = _CAMERA.project(points)
    assert not inside.any() and bool(np.isnan(pixels[:5]).all()), "an image of what is not in front"
    places = _CAMERA.pixels()[::25, ::25].reshape(-1, 2)
    back, seen = _CAMERA.project(_CAMERA.rays(places) * 37.0)
    assert bool(seen.all()), "a pixel outside its own image"
    return largest(back, places)


def _boxes() -> str:
    """A box of 4 x 2 x 1.5 m: points 1 mm inside and outside each face; what is not finite is in none."""
    half_m, centre = np.array([2.0, 1.0, 0.75]), np.array([5e6, -5e6, 5e6])
    box = np.diag([*(2.0 * half_m), 1.0])
    box[:3, 3] = centre
    faces = np.concatenate([np.diag(half_m + off) * side for off in (-1e-3, 1e-3) for side in (1.0, -1.0)])
    broken = np.array([[math.nan] * 3, [math.inf, 0.0, 0.0], [-math.inf] * 3])
    with np.errstate(invalid="ignore"):  # numpy warns of infinity times 0
        inside = inside_any(np.concatenate([centre + faces, broken]), box[None]).tolist()
    assert inside == [True] * 6 + [False] * 9, f"{inside}"
    return "6 inside, 6 outside, 3 not finite in none"


def _leaving() -> float:
    rng = np.random.default_rng(0)
    origins = np.concatenate([rng.uniform(-1, 1, (500, 3)), [[1.0, 0, 0], [-1.0, 0, 0], [3.0, 0, 0]]])
    directions = rng.normal(size=(503, 3))
    directions[:300] *= rng.random((300, 3)) < 0.5
    directions[-3:] = [[1.0, 0, 0]] * 3
    directions[~directions.any(axis=1)] = [0.0, 0.0, 1.0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = [torch.from_numpy(a).float() for a in (origins, directions)]
    exact = []
    for o, d in zip(*(ray.tolist() for ray in rays), strict=True):
        exits = [((1.0 if b > 0 else -1.0) - a) / b for a, b in zip(o, d, strict=True) if abs(b) > 1e-12]
        exact.append(max(min(exits), 0.0))
    size = np.maximum(exact, 1.0)
    return largest(leave_box(*rays, 1.0).double().numpy() / size, np.array(exact) / size)


_MOVE, _LOG, _AT_80_M = "sensors.sweep.Trajectory.move_rays", "geometry.se3.log_se3", "m at 80 m"
CASES = (
    Case("geometry.se3.exp_se3", "12 axes, angles 0 to pi, 1e-300 included; the series' seam at 1e-3",
         lambda: max(largest(exp_se3(twist), _exact_motion(twist)) for twist in _TWISTS), 1e-14, "m"),
    Case(_LOG, "the same: exp(log(motion)) is the motion",
         lambda: max(largest(exp_se3(log_se3(m)), m) for m in map(exp_se3, _TWISTS)), 1e-13, "m"),
    Case(_LOG, "twists back, up to pi - 1e-6", _logarithm, LENGTH_M, "m, rad"),
    Case("geometry.se3.log_so3", "1e-300 to 1e-3 rad, relative", _tiny_angles, 1e-12, "relative"),
    Case(_MOVE, "no rotation", lambda: _sweep(0.0), LENGTH_M, _AT_80_M),
    Case(_MOVE, "1e-9 rad a frame", lambda: _sweep(1e-9), LENGTH_M, _AT_80_M),
    Case(_MOVE, "1e-3 rad a frame", lambda: _sweep(1e-3), LENGTH_M, _AT_80_M),
    Case(_MOVE, "pi - 1e-6 rad a frame", lambda: _sweep(_NEARLY_PI), 1e-6, _AT_80_M),
    Case(_MOVE, "180 degrees a frame", lambda: _sweep(math.pi), LENGTH_M, _AT_80_M),
    Case("sensors.beam_table.wrap_angle", "±50 rad, multiples of pi ± 1 float", _wrap, 1e-14, "turns"),
    Case("sensors.sweep.Trajectory", "a pose is NaN (outside)",
         refused(DataError, lambda: _poses(np.arange(3.0), math.nan))),
    Case("sensors.sweep.Trajectory", "two poses at one time (outside)",
         refused(DataError, lambda: _poses(np.zeros(2)))),
    Case("sensors.sweep.Trajectory.at", "NaN; a time far outside (outside)",
         refused(DataError, lambda: _poses(np.arange(2.0)).at(np.array([math.nan])),
                 lambda: _poses(np.arange(2.0)).at(np.array([9.0])))),
    Case("geometry.fisheye.MeiFisheye.project", "0 to 116.8 degrees, 1 mm to 10 km", _project, 1e-6, "px"),
    Case("geometry.fisheye.MeiFisheye.project", "beyond the last image, and the centre (outside)", _beyond),
    Case("geometry.pinhole.Pinhole", "z = 0, ±0, 1e-9, behind; every 25th pixel and back", _pinhole, 1e-9,
         "px"),
    Case("geometry.boxes.inside_any", "a box 8,660 km out: faces ± 1 mm, NaN, ±inf", _boxes),
    Case("rendering.scaled_rays.leave_box", "along axes, from faces, from outside", _leaving, 1e-5,
         "relative"),
)  # fmt: skip
