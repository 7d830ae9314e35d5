"""Rotations near 0 and 180 degrees: exponential, logarithm, and sweeps that turn so."""

import math
from itertools import pairwise

import mpmath
import numpy as np

from benchmarks.numerics.cases.case import Case, Reading, refused
from benchmarks.numerics.cases.tolerances import LENGTH_M
from nvsf_core.errors import ShapeError
from nvsf_core.geometry.se3 import exp_se3, exp_so3, interpolate_poses, invert_pose, log_se3, log_so3
from nvsf_core.sensors.beam_table import wrap_angle
from nvsf_core.sensors.sweep import Trajectory, sweep_fraction

TITLE = "Rotations"
_ANGLES = (
    0.0, 1e-300, 1e-160, 1e-16, 1e-12, 1e-9, 1e-6, 9.99e-4, 1e-3, 1.001e-3, 0.01, 0.5, 1.0, 2.0, 3.0, 3.14,
    math.pi - 1e-6, math.pi - 1e-9, math.pi - 1e-12, math.pi,
)  # fmt: skip


def _axes() -> np.ndarray:
    random = np.random.default_rng(0).normal(size=(6, 3))
    axes: np.ndarray = np.concatenate(
        [np.eye(3), -np.eye(3), random / np.linalg.norm(random, axis=1)[:, None]]
    )
    return axes


def _exact_motion(twist: np.ndarray, share: float = 1.0) -> np.ndarray:
    """The matrix exponential of share x twist by mpmath's Taylor series, 40 digits."""
    with mpmath.workdps(40):
        rho, phi = (
            [mpmath.mpf(float(v)) * mpmath.mpf(share) for v in half] for half in (twist[:3], twist[3:])
        )
        matrix = mpmath.matrix(
            [
                [0, -phi[2], phi[1], rho[0]],
                [phi[2], 0, -phi[0], rho[1]],
                [-phi[1], phi[0], 0, rho[2]],
                [0] * 4,
            ]
        )
        return np.array(mpmath.expm(matrix, method="taylor").tolist(), dtype=np.float64)


def _twists() -> list[np.ndarray]:
    translation = np.array([1.2, -0.3, 0.1])
    return [np.concatenate([translation, axis * angle]) for axis in _axes() for angle in _ANGLES]


def _exponential() -> Reading:
    error = max(float(np.abs(exp_se3(twist) - _exact_motion(twist)).max()) for twist in _twists())
    return Reading(error=error, limit=1e-14, unit="m", outcome="each of 12 axes; seam of the series at 1e-3")


def _round_trip() -> Reading:
    """The logarithm's own motion is the motion; at 180 degrees either axis is right."""
    worst, finite = 0.0, True
    for twist in _twists():
        motion = exp_se3(twist)
        back = log_se3(motion)
        finite &= bool(np.isfinite(back).all())
        worst = max(worst, float(np.abs(exp_se3(back) - motion).max()))
    return Reading(error=worst, limit=1e-13, unit="m", is_refuted=not finite)


def _logarithm() -> Reading:
    """Angle and axis themselves, up to pi - 1e-6 rad: nearer the axis is ill-conditioned."""
    worst = 0.0
    for twist in _twists():
        if np.linalg.norm(twist[3:]) < math.pi - 1e-7:
            worst = max(worst, float(np.abs(log_se3(exp_se3(twist)) - twist).max()))
    return Reading(error=worst, limit=LENGTH_M, unit="m, rad")


def _tiny_angles() -> Reading:
    """Relative error of rotation vectors from 1e-300 to 1e-3 rad."""
    worst = 0.0
    for angle in np.geomspace(1e-300, 1e-3, 200):
        vector = np.array([0.6, 0.0, 0.8]) * angle
        worst = max(worst, float(np.abs(log_so3(exp_so3(vector)) - vector).max() / angle))
    return Reading(error=worst, limit=1e-12, unit="relative")


def _large_angles() -> Reading:
    """Many turns: the exponential is still a rotation."""
    vectors = _axes()[None] * np.array([2 * math.pi, 10.0, 1e3, 1e6])[:, None, None]
    rotations = exp_so3(vectors)
    error = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max()
    return Reading(error=float(error), limit=1e-9, unit="")


def _sweep(angle: float) -> Reading:
    """Rays of a sweep whose sensor turns by some angle from frame to frame, against the exact motion."""
    worst = 0.0
    shares = np.linspace(0.0, 1.0, 9)
    for axis in _axes():
        twist = np.concatenate([[1.2, -0.3, 0.1], axis * angle])
        # At 180 degrees the way round is not in the poses: the reference takes the one that was chosen.
        chosen = log_se3(exp_se3(twist)) if angle > math.pi - 1e-5 else twist
        trajectory = Trajectory(np.array([0.0, 0.1]), np.stack([np.eye(4), exp_se3(twist)]), np.zeros(3))
        origin, direction = np.tile([0.0, 0.0, 0.2], (9, 1)), np.tile([0.6, 0.0, 0.8], (9, 1))
        start, towards = trajectory.move_rays(origin, direction, shares * 0.1)
        for k, share in enumerate(shares):
            motion = _exact_motion(chosen, float(share))
            end = motion[:3, :3] @ (origin[k] + 80.0 * direction[k]) + motion[:3, 3]
            worst = max(worst, float(np.abs(start[k] + 80.0 * towards[k] - end).max()))
    return Reading(error=worst, limit=1e-6 if 0 < math.pi - angle < 1e-5 else 1e-9, unit="m at 80 m")


def _interpolation_ends() -> Reading:
    worst = 0.0
    for twist in _twists():
        first, second = exp_se3(np.array([3.0, 1.0, 0.0, 0.2, 0.1, -2.0])), exp_se3(twist)
        for share, expected in ((0.0, first), (1.0, second)):
            worst = max(worst, float(np.abs(interpolate_poses(first, second, share) - expected).max()))
    return Reading(error=worst, limit=1e-13, unit="m")


def _long_chain() -> Reading:
    """A thousand poses there and back: rounding piles up, but stays a rigid motion."""
    steps = [exp_se3(np.array([1.2, 0.0, 0.0, 0.01, 0.02, 0.03])) for _ in range(1000)]
    pose = np.eye(4)
    for step in steps:
        pose = pose @ step
    for _, step in pairwise([*steps, steps[0]]):
        pose = pose @ invert_pose(step)
    return Reading(error=float(np.abs(pose - np.eye(4)).max()), limit=LENGTH_M, unit="m")


def _wrap() -> Reading:
    """Every angle lands in (-pi, pi], multiples of pi and their neighbours too; the turn stays the same."""
    multiples = np.arange(-9, 10) * np.pi
    around = [np.nextafter(multiples, side) for side in (-np.inf, np.inf)]
    angles = np.concatenate([multiples, *around, [0.0, -0.0, 1e-300, -1e-300], np.linspace(-50, 50, 4001)])
    wrapped, fraction = wrap_angle(angles), sweep_fraction(angles)
    inside = bool(((wrapped > -np.pi) & (wrapped <= np.pi)).all())
    inside &= bool(((fraction >= -0.5) & (fraction < 0.5)).all())
    turns = (angles - wrapped) / (2 * np.pi)
    error = float(np.abs(turns - np.rint(turns)).max())
    return Reading(
        error=error, limit=1e-14, unit="turns", outcome=f"within (-pi, pi]: {inside}", is_refuted=not inside
    )


CASES = (
    Case("geometry.se3.exp_se3", "12 axes, angles 0 to pi, 1e-300 included", _exponential),
    Case("geometry.se3.log_se3", "the same: exp(log(motion)) is the motion", _round_trip),
    Case("geometry.se3.log_se3", "twists back, up to pi - 1e-6", _logarithm),
    Case("geometry.se3.log_so3", "1e-300 to 1e-3 rad, relative", _tiny_angles),
    Case("geometry.se3.exp_so3", "2 pi to 1e6 rad: still orthonormal", _large_angles),
    Case("geometry.se3.interpolate_poses", "both ends, 240 motions", _interpolation_ends),
    Case("geometry.se3.invert_pose", "a chain of 1,000 poses there and back", _long_chain),
    Case("sensors.sweep.Trajectory.move_rays", "no rotation", lambda: _sweep(0.0)),
    Case("sensors.sweep.Trajectory.move_rays", "1e-9 rad a frame", lambda: _sweep(1e-9)),
    Case("sensors.sweep.Trajectory.move_rays", "1e-3 rad a frame", lambda: _sweep(1e-3)),
    Case("sensors.sweep.Trajectory.move_rays", "pi - 1e-6 rad a frame", lambda: _sweep(math.pi - 1e-6)),
    Case("sensors.sweep.Trajectory.move_rays", "180 degrees a frame", lambda: _sweep(math.pi)),
    Case("sensors.beam_table.wrap_angle", "±50 rad, multiples of pi ± 1 float", _wrap),
    Case(
        "geometry.se3.log_se3", "3x3 instead of 4x4 (outside)",
        lambda: refused(ShapeError, lambda: log_se3(np.eye(3))),
    ),
)  # fmt: skip
