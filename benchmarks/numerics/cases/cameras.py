"""Fisheye at and beyond 90 degrees; pinhole beside and behind; boxes."""

import math

import mpmath
import numpy as np
import torch

from benchmarks.numerics.cases.case import Case, Reading, refused
from nvsf_core.errors import CalibrationError, ShapeError
from nvsf_core.geometry.boxes import inside_any
from nvsf_core.geometry.fisheye import MeiFisheye
from nvsf_core.geometry.pinhole import Pinhole
from nvsf_core.rendering.scaled_rays import leave_box

TITLE = "Cameras and boxes"
_PIXEL = 1e-6
KITTI_360 = MeiFisheye(
    xi=2.2134, k1=0.016798, k2=1.6548, p1=4.2223e-4, p2=4.2462e-4, gamma1=1336.3, gamma2=1335.8,
    u0=716.94, v0=705.76, width=1400, height=1400,
)  # fmt: skip
"""KITTI-360's image_02, rounded."""


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


def _directions(angles_deg: np.ndarray, length: float = 1.0) -> np.ndarray:
    """Directions at angles from the optical axis, round the clock."""
    turn = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    angle, around = (a.ravel() for a in np.meshgrid(np.deg2rad(angles_deg), turn))
    return length * np.stack(
        [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1
    )


def _project() -> Reading:
    angles = np.array([0.0, 1e-9, 1e-3, 45, 89.999, 90.0, 90.001, 95, 100, 110, 116.8])
    points = np.concatenate([_directions(angles, length) for length in (1e-3, 1.0, 1e4)])
    pixels, _ = KITTI_360.project(points)
    exact = np.array([_exact_pixel(KITTI_360, point) for point in points])
    return Reading(error=float(np.abs(pixels - exact).max()), limit=_PIXEL, unit="px")


def _beyond() -> Reading:
    """Past cos = -1/xi the model folds back: no image, NaN, and never inside."""
    edge = math.degrees(math.acos(-1.0 / KITTI_360.xi))
    points = np.concatenate([_directions(np.array([edge + 0.01, 150.0, 179.99, 180.0])), np.zeros((1, 3))])
    pixels, inside = KITTI_360.project(points)
    none = bool(np.isnan(pixels).all()) and not bool(inside.any())
    return Reading(
        outcome=f"no image beyond {edge:.2f} degrees, nor of the centre: {none}", is_refuted=not none
    )


def _round_trip() -> Reading:
    """Project and back, up to 100 degrees; distortion stays one to one there."""
    points = _directions(np.linspace(0.0, 100.0, 60))
    pixels, _ = KITTI_360.project(points)
    back, solved = KITTI_360.unproject(pixels)
    error = float(np.abs(back - points)[solved].max())
    share = float(solved.mean())
    return Reading(error=error, limit=1e-8, unit="", outcome=f"{share:.1%} solved", is_refuted=share < 0.999)


def _image_corners() -> Reading:
    """Pixels of the whole image, its dark corners and far outside: a direction that projects back, or NaN."""
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-5000, 6400, 58), np.linspace(-5000, 6400, 58)))
    pixels = np.stack([u, v], axis=1)
    directions, solved = KITTI_360.unproject(pixels)
    again, _ = KITTI_360.project(directions[solved])
    there = np.isfinite(again).all(axis=1)
    error = float(np.abs(again - pixels[solved])[there].max())
    honest = bool(np.isnan(directions[~solved]).all())
    return Reading(
        error=error, limit=1e-4, unit="px", is_refuted=not honest or int(there.sum()) == 0,
        outcome=f"{solved.mean():.0%} solved, {there.mean():.0%} of those one to one; others NaN: {honest}",
    )  # fmt: skip


def _other_models() -> Reading:
    """Xi = 0 (pinhole), below, at and above 1, without distortion: against the formula in 40 digits."""
    worst = 0.0
    for xi in (0.0, 0.5, 1.0, 1.5):
        camera = MeiFisheye(xi, 0.0, 0.0, 0.0, 0.0, 500.0, 500.0, 500.0, 500.0, 1000, 1000)
        most = 89.0 if xi == 0.0 else (119.0 if xi == 0.5 else (170.0 if xi == 1.0 else 131.0))
        points = _directions(np.linspace(0.0, most, 40))
        pixels, _ = camera.project(points)
        exact = np.array([_exact_pixel(camera, point) for point in points])
        worst = max(worst, float((np.abs(pixels - exact) / np.maximum(np.abs(exact), 1.0)).max()))
    return Reading(error=worst, limit=1e-9, unit="relative")


_CAMERA = Pinhole(fx=552.55, fy=552.55, cx=682.05, cy=238.77, width=1408, height=376)


def _pinhole() -> Reading:
    """Beside, behind and on the camera: never inside, NaN behind; in front it inverts."""
    points = np.array([[1, 1, 0.0], [1, 1, -0.0], [0, 0, 0], [1, 1, -5], [0, 0, -1e-300], [1e3, 0, 1e-9]])
    pixels, inside = _CAMERA.project(points)
    sound = not bool(inside.any()) and bool(np.isnan(pixels[:5]).all())
    places = _CAMERA.pixels()[::25, ::25].reshape(-1, 2)
    back, seen = _CAMERA.project(_CAMERA.rays(places) * 37.0)
    error = float(np.abs(back - places).max())
    return Reading(error=error, limit=1e-9, unit="px", is_refuted=not sound or not bool(seen.all()))


def _boxes() -> Reading:
    """A box 5e6 m out, points on its faces ± 1 mm; not finite points are in none."""
    box = np.diag([4.0, 2.0, 1.5, 1.0])
    box[:3, 3] = (5e6, -5e6, 5e6)
    offsets = np.array(
        [[1.999, 0, 0], [2.001, 0, 0], [0, 0.999, 0], [0, 1.001, 0], [0, 0, 0.749], [0, 0, 0.751]]
    )
    points = np.concatenate([box[:3, 3] + offsets, [[np.nan] * 3, [np.inf, 0, 0]]])
    with np.errstate(invalid="ignore"):
        inside = inside_any(points, box[None])
    expected = [True, False] * 3 + [False, False]
    return Reading(outcome=f"{inside.tolist()}", is_refuted=inside.tolist() != expected)


def _leaving() -> Reading:
    """Rays along axes, from faces, from outside, against a float64 formula written per axis."""
    rng = np.random.default_rng(0)
    origins = np.concatenate([rng.uniform(-1, 1, (500, 3)), [[1.0, 0, 0], [-1.0, 0, 0], [3.0, 0, 0]]])
    directions = rng.normal(size=(503, 3))
    directions[:300] *= rng.random((300, 3)) < 0.5
    directions[-3:] = [[1.0, 0, 0]] * 3
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.where(length > 0, directions / np.where(length > 0, length, 1.0), [[0.0, 0.0, 1.0]])
    found = leave_box(*(torch.from_numpy(a.astype(np.float32)) for a in (origins, directions)), 1.0).numpy()
    exact = []
    for o, d in zip(origins.astype(np.float32).tolist(), directions.astype(np.float32).tolist(), strict=True):
        exits = [((1.0 if b > 0 else -1.0) - a) / b for a, b in zip(o, d, strict=True) if abs(b) > 1e-12]
        exact.append(max(min(exits), 0.0))
    wrong = np.abs(found - exact) / np.maximum(exact, 1.0)
    return Reading(error=float(wrong.max()), limit=1e-5, unit="relative", float32="ok")


CASES = (
    Case("geometry.fisheye.MeiFisheye.project", "0 to 116.8 degrees, 1 mm to 10 km", _project),
    Case("geometry.fisheye.MeiFisheye.project", "beyond the last image, and the centre (outside)", _beyond),
    Case("geometry.fisheye.MeiFisheye.unproject", "0 to 100 degrees and back", _round_trip),
    Case("geometry.fisheye.MeiFisheye.unproject", "pixels to 5,000 px outside the image", _image_corners),
    Case("geometry.fisheye.MeiFisheye.project", "xi = 0, 0.5, 1, 1.5", _other_models),
    Case("geometry.pinhole.Pinhole", "z = 0, ±0, 1e-9, behind; every 25th pixel and back", _pinhole),
    Case("geometry.boxes.inside_any", "a box 8,660 km out, faces ± 1 mm, NaN", _boxes),
    Case("rendering.scaled_rays.leave_box", "along axes, from faces, from outside", _leaving),
    Case(
        "geometry.fisheye.MeiFisheye", "xi = NaN (outside)",
        lambda: refused(CalibrationError, lambda: MeiFisheye(math.nan, 0, 0, 0, 0, 1, 1, 0, 0, 9, 9)),
    ),
    Case(
        "geometry.pinhole.Pinhole", "focal length 0 (outside)",
        lambda: refused(CalibrationError, lambda: Pinhole(0.0, 1.0, 0.0, 0.0, 9, 9)),
    ),
    Case(
        "geometry.pinhole.Pinhole.project", "points (N, 2) (outside)",
        lambda: refused(ShapeError, lambda: _CAMERA.project(np.zeros((3, 2)))),
    ),
)  # fmt: skip
