"""Encoders of positions, directions and times, where cells and intervals end."""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from scipy.special import sph_harm_y
from torch import Tensor
from torch.nn.functional import grid_sample

from benchmarks.numerics.cases.case import Case, Reading, largest, refused
from benchmarks.numerics.cases.references import against, by_autograd
from benchmarks.numerics.cases.tolerances import ELEMENTWISE_ULP, GRADIENT
from nvsf_core.encodings.directions import frequency_encode, spherical_harmonics
from nvsf_core.encodings.hash_time import cubic_basis
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.kernels.encodings.hash_grid import GridLayout, hash_grid_encode
from nvsf_core.kernels.encodings.planes import planes_sample

TITLE = "Encoders"
_FINE = GridLayout(4, 2, 19, 16, 20_000)
"""The finest cell is 1 cm in a box of 200 m."""
_FINEST = GridLayout(2, 2, 19, 16, 1 << 20)
"""As fine as a layout may be."""
_STATIC = GridLayout(levels=8, features=4, log2_table=19, base_resolution=512, finest_resolution=32768)
"""The paper's static hash."""
_SMALL = GridLayout(3, 2, 12, 8, 64)


def _hard_positions(layout: GridLayout) -> np.ndarray:
    """Random places, cell borders of every level and their neighbours in float32, faces, corners, outside."""
    rng = np.random.default_rng(0)
    random = rng.random((4000, 3))
    borders = [(rng.integers(0, max(int(scale), 1), (300, 3)) + 0.5) / scale for scale in layout.scales]
    exact = np.concatenate([random, *borders]).astype(np.float32)
    around = [np.nextafter(exact[4000:], np.float32(side)) for side in (0.0, 1.0)]
    corners = np.array(list(itertools.product((0.0, 1.0, 0.5), repeat=3)), np.float32)
    outside = rng.uniform(-3.0, 4.0, (300, 3)).astype(np.float32)
    far = np.array([[math.inf, -math.inf, 0.5], [1e30, -1e30, 1e-30]], np.float32)
    return np.concatenate([exact, *around, corners, outside, far])


def _table(layout: GridLayout) -> Tensor:
    draws = torch.Generator().manual_seed(0)
    return torch.rand(layout.entries, layout.features, generator=draws) * 2.0 - 1.0


def _hash(layout: GridLayout) -> Reading:
    """The kernel against the plain-torch oracle in float64."""
    # A position is off by half an eps, times the resolution, along three axes; features differ by up to 2.
    allowed = 6.0 * (torch.tensor(layout.scales).repeat_interleave(layout.features).double() + 8.0)
    positions, table = _hard_positions(layout), _table(layout)
    return against(
        lambda x: hash_grid_encode(x, table.to(x.device), layout).double() / allowed.to(x.device),
        by_autograd(lambda x: hash_grid_encode(x, table.double(), layout) / allowed), [positions],
        scale=1.0, gradient_scale=None,
    )  # fmt: skip


def _hash_gradient() -> Reading:
    """Of the table, weighted with a random colour, at all hard places; of positions, at the random ones.

    On a border float32 and float64 may stand in neighbouring cells: either slope is right there.
    """
    colour = torch.rand(_SMALL.outputs, generator=torch.Generator().manual_seed(1))
    hard, table = torch.from_numpy(_hard_positions(_SMALL)[:-2]), _table(_SMALL)

    both = []
    for dtype in (torch.float32, torch.float64):
        leaves = [leaf.to(dtype).requires_grad_() for leaf in (hard, table)]
        both.append(torch.autograd.grad((hash_grid_encode(*leaves, _SMALL) * colour.to(dtype)).sum(), leaves))
    (by_place, by_table), (true_place, true_table) = both
    assert bool(by_place.isfinite().all()), "a gradient of positions is not finite"
    differing = (by_place - true_place).abs().amax(dim=1)[:4000].quantile(0.99) / true_place.abs().max()
    error = max(largest(by_table, true_table) / float(true_table.abs().max()), float(differing))
    return Reading(gradient=error, gradient_limit=10 * GRADIENT)


def _hash_nan() -> str:
    encoded = hash_grid_encode(torch.tensor([[math.nan, 0.5, 0.5], [0.5, 0.5, 0.5]]), _table(_SMALL), _SMALL)
    assert bool(encoded[0].isnan().all() and encoded[1].isfinite().all()), f"{encoded}"
    return "NaN encoding, its neighbours untouched"


def _far_box() -> float:
    bounds = Bounds(centre_m=(1000.0, -1000.0, 3.0), half_m=100.0)
    points = np.array(bounds.centre_m) + np.random.default_rng(0).uniform(-100.0, 100.0, (4000, 3))
    single = torch.from_numpy(points.astype(np.float32))
    exact = (single.double() - torch.tensor(bounds.centre_m)) / 200.0 + 0.5
    there_and_back = bounds.to_metres(bounds.to_scaled(single))
    return max(largest(there_and_back, single), 200.0 * largest(bounds.to_unit(single), exact))


def _plain_planes(coordinates: Tensor, plane: Tensor) -> Tensor:
    grid = (coordinates.clamp(0, 1) * 2 - 1)[None, None]
    found = grid_sample(plane[None], grid, mode="bilinear", padding_mode="border", align_corners=True)
    return found[0, :, 0].T


def _planes() -> Reading:
    plane = np.random.default_rng(1).uniform(-1.0, 1.0, (8, 25, 512))
    rng = np.random.default_rng(0)
    borders = np.clip(rng.integers(0, 512, (500, 2)) / np.array([511.0, 24.0]), 0, 1)
    corners = list(itertools.product((0.0, 1.0, -2.0, 3.0), repeat=2))
    places = np.concatenate([rng.random((3000, 2)), borders, corners])
    exact = by_autograd(_plain_planes)
    # A coordinate is off by half an eps, times the resolution of 512; features differ by up to 2.
    return against(planes_sample, exact, [places, plane], scale=1024.0, gradient_scale=None)


def _planes_gradient() -> Reading:
    rng = np.random.default_rng(0)
    inputs = [rng.random((3000, 2)), rng.random((4, 9, 33))]
    squared = by_autograd(lambda *x: _plain_planes(*x).square())
    return against(lambda *x: planes_sample(*x).square(), squared, inputs, scale=33.0, gradient_scale=33.0)


def _transposed(encode: Callable[..., Tensor], entries: tuple[int, ...], axes: int) -> Reading:
    """Over all points the adjoint is the transpose: sum of c . E(x, T) is that of T . (dE/dT)^T c.

    Numbers above 0 cancel nowhere. A twelfth of the positions lies outside on each side of an axis.
    """
    draws = torch.Generator().manual_seed(0)
    table = torch.rand(entries, generator=draws).requires_grad_()
    features = encode(torch.rand(2_000_000, axes, generator=draws) * 1.2 - 0.1, table)
    cotangent = torch.rand(features.shape, generator=draws)
    (gradient,) = torch.autograd.grad(features, table, cotangent)
    forward, adjoint = ((a * b).double().sum().item() for a, b in ((features, cotangent), (gradient, table)))
    return Reading(gradient=abs(forward - adjoint) / forward)


def _frequency(most: float) -> Reading:
    rng = np.random.default_rng(0)
    numbers = np.concatenate([[0.0, 0.5, 1.0, 0.25], rng.uniform(-1.0, 1.0, 400) * most])[:, None]

    def plain(x: Tensor) -> Tensor:
        turns = [torch.remainder(x * 2.0**k, 2.0) for k in range(12)]
        waves = [wave(math.pi * turn) for turn in turns for wave in (torch.sin, torch.cos)]
        return torch.cat(waves, dim=1)

    # The slope is 2^k pi: its roundings count beside the steepest octave's.
    steepest = 2.0**11 * math.pi
    return against(
        lambda x: frequency_encode(x, 12), by_autograd(plain), [numbers], scale=1.0, gradient_scale=steepest
    )


def _plain_harmonics(directions: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    x, y, z = directions[0].T
    polar, azimuth, columns = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x), []
    for band, order in [(b, o) for b in range(4) for o in range(-b, b + 1)]:
        found = sph_harm_y(band, abs(order), polar, azimuth) * (math.sqrt(2.0) if order else 1.0)
        columns.append(found.imag if order < 0 else found.real)
    return np.stack(columns, axis=1), []


def _harmonics() -> Reading:
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = np.concatenate([directions, np.eye(3), -np.eye(3)])
    return against(spherical_harmonics, _plain_harmonics, [places], scale=1.0, gradient_scale=None)


def _basis() -> float:
    """Polynomials up to the third degree come back exactly."""
    nodes, times = np.array([0.0, 1 / 3, 2 / 3, 1.0]), np.linspace(0.0, 1.0, 2001).tolist()
    wrong = (
        abs(float(cubic_basis(t).numpy() @ nodes**power) - t**power) for t in times for power in range(4)
    )
    return max(wrong) / np.finfo(np.float64).eps


_HASH, _PLANES = "kernels.encodings.hash_grid.hash_grid_encode", "kernels.encodings.planes.planes_sample"
_FREQUENCY = "encodings.directions.frequency_encode"
_HARD, _ALLOWED = "cell borders ± 1 float, corners, faces, outside, ±inf", "of eps x resolution x difference"
CASES = (
    Case(_HASH, f"1 cm cells in a 200 m box (20,000 a side): {_HARD}", lambda: _hash(_FINE), 1.0, _ALLOWED),
    Case(_HASH, f"2^20 cells a side, the finest layout: {_HARD}", lambda: _hash(_FINEST), 1.0, _ALLOWED),
    Case(_HASH, f"gradients of table and positions: {_HARD}", _hash_gradient),
    Case(_HASH, "NaN (outside)", _hash_nan),
    Case("geometry.bounds.Bounds", "a 200 m box 1.4 km out: to the unit cube and back", _far_box, 1e-3, "m"),
    Case(_PLANES, "25 x 512 points: borders, corners, outside", _planes, 2.0, _ALLOWED),
    Case(_PLANES, "gradients of plane and coordinates", _planes_gradient, 1.0, _ALLOWED),
    Case(_HASH, "2e6 points in the paper's static hash: gradient of the table",
         lambda: _transposed(partial(hash_grid_encode, layout=_STATIC), (_STATIC.entries, 4), 3)),
    Case(_PLANES, "2e6 points in the paper's finest plane, 8 x 256 x 256: gradient of the plane",
         lambda: _transposed(planes_sample, (8, 256, 256), 2)),
    Case(_FREQUENCY, "12 octaves, -1 to 1", lambda: _frequency(1.0), ELEMENTWISE_ULP, "ulp"),
    Case(_FREQUENCY, "12 octaves, ±3.4e38", lambda: _frequency(3.4e38), ELEMENTWISE_ULP, "ulp"),
    # A float32 direction is a unit vector to within an eps, and a harmonic of band 3 is a cubic of it.
    Case("encodings.directions.spherical_harmonics", "the whole sphere, its poles", _harmonics, 32.0, "eps"),
    Case("encodings.hash_time.cubic_basis", "t 0 to 1", _basis, ELEMENTWISE_ULP, "eps"),
    Case("encodings.hash_time.cubic_basis", "t = 1.01, NaN (outside)",
         refused(ValueError, lambda: cubic_basis(1.01), lambda: cubic_basis(math.nan))),
)  # fmt: skip
