"""Whether a rendered image agrees with recorded ones: it is carried back into them by its own depth.

A pixel's surface, at its rendered depth, lies somewhere in each recorded image of the camera. Two numbers say
how far its colour can be trusted. One is measured: the difference to the image that looks at the surface
from the direction most like the view's (least parallax). A wrong depth, a ghost or a blurred texture shows
there. The other is expected: by how much recorded images, treated in the same way, differ at that parallax.
It grows with the way to the nearest image, also where the rendered image happens to agree with it. Pixels
that no image shows, and guessed ones, get the difference of recorded pixels `_FILL_PX` apart: what is
guessed continues its surroundings.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.geometry.se3 import invert_pose, transform_points
from nvsf_core.recording.images import CameraImages

_NEAREST = 16
"""Recorded images, nearest in place, that an image is compared with."""
_SAMPLES = 15_000
"""Pixels of an image that are compared, about, evenly spaced."""
_SKY_M = 500.0
"""Where surfaces without a depth, or farther ones, are taken to be."""
_FILL_PX = 16
_TOP = 255.0
_EDGES_RAD = (0.0, 0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64, np.pi)
"""Edges of the steps of parallax: each twice the last."""


@dataclass(frozen=True, slots=True, eq=False)
class LookBack:
    """Some pixels of an image, as k recorded images show their surfaces."""

    squared: np.ndarray
    """(k, m) float64 squared difference of colour, mean of the channels, 0..1; inf = not shown."""
    parallax_rad: np.ndarray
    """(k, m) angle between the image's ray and the recorded one; inf = not shown."""
    pixel: np.ndarray
    """(m,) int64: the pixels, as row * width + column."""


@dataclass(frozen=True, slots=True, eq=False)
class ParallaxCurve:
    """How far recorded images differ, by parallax, and where nothing is known."""

    squared: np.ndarray
    """(b,) squared difference of each step of parallax; never falls."""
    fill: float
    """Squared difference of recorded pixels that are `_FILL_PX` apart."""


def look_back(
    rgb: np.ndarray, range_m: np.ndarray, camera_to_world: np.ndarray, recorded: CameraImages
) -> LookBack:
    """Compare an image with the recorded ones nearest to it.

    Args:
        rgb: (H, W, 3) uint8.
        range_m: (H, W) length of each pixel's ray, metres; inf or 0 = without surface.
        camera_to_world: (4, 4), in the frame of the recorded poses.
        recorded: Images of the same camera, H x W.

    Raises:
        DataError: The image has another size than the recorded ones, or none is recorded.
    """
    pinhole = recorded.pinhole
    expected = (pinhole.height, pinhole.width)
    if rgb.shape != (*expected, 3) or range_m.shape != expected or len(recorded.rgb) == 0:
        raise DataError(
            f"photo consistency: expected an image and ranges of {expected} pixels and a recorded image of "
            f"that size, found {rgb.shape}, {range_m.shape} and {len(recorded.rgb)} images; render it again"
        )
    pixel = recorded.pixel[:: max(1, len(recorded.pixel) // _SAMPLES)]
    colour = rgb.reshape(-1, 3)[pixel] / _TOP
    length_m = range_m.reshape(-1)[pixel].astype(np.float64)
    length_m = np.where(np.isfinite(length_m) & (length_m > 0.0), np.minimum(length_m, _SKY_M), _SKY_M)
    rays = pinhole.rays(np.stack([pixel % pinhole.width, pixel // pinhole.width], axis=-1))
    point_m = transform_points(camera_to_world, rays * length_m[:, None])
    away_m = np.linalg.norm(recorded.pose[:, :3, 3] - camera_to_world[:3, 3], axis=1)
    found = [
        _in_image(point_m, colour, camera_to_world[:3, 3], recorded, source)
        for source in np.argsort(away_m, kind="stable")[:_NEAREST].tolist()
    ]
    return LookBack(np.stack([one for one, _ in found]), np.stack([one for _, one in found]), pixel)


def nearest_difference(look: LookBack) -> np.ndarray:
    """(m,) squared difference to the image of least parallax; inf where no image shows the pixel."""
    least = np.argmin(look.parallax_rad, axis=0)
    return np.asarray(np.take_along_axis(look.squared, least[None], axis=0)[0])


def parallax_curve(looks: Sequence[LookBack], fills: Sequence[float]) -> ParallaxCurve | None:
    """The curve of recorded images that were carried back; None if no other image shows any of them.

    By the depths that were rendered for the place of each; `fills` are their `fill_difference`.
    """
    total, count = np.zeros((2, len(_EDGES_RAD) - 1))
    for look in looks:
        shown = np.isfinite(look.squared)
        step = _steps(look.parallax_rad[shown])
        total += np.bincount(step, look.squared[shown], minlength=len(total))
        count += np.bincount(step, minlength=len(count))
    if count.sum() == 0:
        return None
    return ParallaxCurve(_never_falling(total, count), float(np.mean(fills)))


def expected_difference(look: LookBack, guessed: np.ndarray, curve: ParallaxCurve) -> np.ndarray:
    """(m,) squared difference that recorded images lead to expect of each pixel; `guessed` is (H, W) bool."""
    least_rad = look.parallax_rad.min(axis=0)
    shown = np.isfinite(least_rad)
    expected = np.full(least_rad.shape, curve.fill)
    expected[shown] = curve.squared[_steps(least_rad[shown])]
    is_guess = guessed.reshape(-1)[look.pixel]
    return np.where(is_guess, np.maximum(expected, curve.fill), expected)


def fill_difference(rgb: np.ndarray, valid: np.ndarray) -> float:
    """Mean squared difference, 0..1, of pixels of an image that lie `_FILL_PX` apart in a row.

    Args:
        rgb: (H, W, 3) uint8.
        valid: (H, W) bool; other pixels are left out.

    Returns:
        NaN if the image is narrower than that.
    """
    both = valid[:, _FILL_PX:] & valid[:, :-_FILL_PX]
    if not both.any():
        return float("nan")
    value = rgb.astype(np.float64) / _TOP
    return float(np.square(value[:, _FILL_PX:] - value[:, :-_FILL_PX])[both].mean())


def _in_image(
    point_m: np.ndarray, colour: np.ndarray, eye_m: np.ndarray, recorded: CameraImages, source: int
) -> tuple[np.ndarray, np.ndarray]:
    """Squared difference and parallax (m,) of points in one recorded image; inf where it shows them not."""
    pinhole, pose = recorded.pinhole, recorded.pose[source]
    place, inside = pinhole.project(transform_points(invert_pose(pose), point_m))
    inside &= recorded.valid.reshape(-1)[_pixel(place, inside, pinhole.width)]
    squared, parallax_rad = np.full((2, len(point_m)), np.inf)
    shown = _bilinear(recorded.rgb[source], place[inside])
    squared[inside] = np.square(shown - colour[inside]).mean(axis=-1)
    one, other = point_m[inside] - eye_m, point_m[inside] - pose[:3, 3]
    lengths = np.linalg.norm(one, axis=-1) * np.linalg.norm(other, axis=-1)
    cosine = (one * other).sum(axis=-1) / np.maximum(lengths, 1e-9)
    parallax_rad[inside] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return squared, parallax_rad


def _pixel(place: np.ndarray, inside: np.ndarray, width: int) -> np.ndarray:
    """(m,) int64 pixel that each place (m, 2) lies in; 0 where it is outside."""
    whole = np.rint(np.where(inside[:, None], place, 0.0)).astype(np.int64)
    return np.asarray(whole[:, 1] * width + whole[:, 0])


def _bilinear(rgb: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(m, 3) colours, 0..1, of an image (H, W, 3) at places (m, 2), as (column, row)."""
    height, width = rgb.shape[:2]
    low = np.floor(place).astype(np.int64)
    weight = place - low
    found = np.zeros((len(place), 3))
    for right in (0, 1):
        for down in (0, 1):
            column = np.clip(low[:, 0] + right, 0, width - 1)
            row = np.clip(low[:, 1] + down, 0, height - 1)
            share = np.abs(1 - right - weight[:, 0]) * np.abs(1 - down - weight[:, 1])
            found += share[:, None] * rgb[row, column]
    return found / _TOP


def _steps(parallax_rad: np.ndarray) -> np.ndarray:
    """Step of `_EDGES_RAD` that each parallax lies in."""
    return np.asarray(np.clip(np.digitize(parallax_rad, _EDGES_RAD) - 1, 0, len(_EDGES_RAD) - 2))


def _never_falling(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Means total / count, of which neighbours that fall, or are of nothing, are pooled (least squares)."""
    pools = list[tuple[float, float, int]]()
    for mine in zip(total.tolist(), count.tolist(), [1] * len(total), strict=True):
        pools.append(mine)
        while len(pools) > 1 and _falls(pools[-2], pools[-1]):
            (total_a, count_a, steps_a), (total_b, count_b, steps_b) = pools[-2:]
            pools[-2:] = [(total_a + total_b, count_a + count_b, steps_a + steps_b)]
    means = [np.full(steps, total / count) for total, count, steps in pools]
    return np.concatenate(means)


def _falls(one: tuple[float, float, int], following: tuple[float, float, int]) -> bool:
    if one[1] == 0 or following[1] == 0:
        return True
    return one[0] / one[1] >= following[0] / following[1]
