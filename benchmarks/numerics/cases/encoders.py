"""Encoders of positions, directions and times, where cells and intervals end."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks.numerics.cases.case import NOT_APPLICABLE, NOT_ON_GPU, Case, Gradient, Reading, refused
from benchmarks.numerics.cases.references import against, by_autograd
from benchmarks.numerics.cases.tolerances import TOLERANCES
from nvsf_core.encodings import cubic_basis, frequency_encode, spherical_harmonics
from nvsf_core.errors import ShapeError
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.kernels import GridLayout, hash_grid_encode, planes_sample

TITLE = "Encoders"
_PRIMES = (1, 2654435761, 805459861)
_FINE = GridLayout(4, 2, 19, 16, 20_000)
"""The finest cell is 1 cm in a box of 200 m."""
_FINEST = GridLayout(2, 2, 19, 16, 1 << 20)
"""As fine as a layout may be."""


def _plain_encode(x: np.ndarray, table: np.ndarray, layout: GridLayout) -> np.ndarray:
    """The hash grid in float64, corner by corner, from Müller et al. 2022 and tiny-cuda-nn's layout."""
    inside = np.clip(x.astype(np.float64), 0.0, 1.0)
    parts, start = [], 0
    growth = (layout.finest_resolution / layout.base_resolution) ** (1.0 / max(layout.levels - 1, 1))
    for level in range(layout.levels):
        scale = round(layout.base_resolution * growth**level - 1.0, 6)
        points = math.ceil(scale) + 1
        place = inside * scale + 0.5
        cell = np.floor(place).astype(np.int64)
        share = place - cell
        is_dense = points**3 <= 1 << layout.log2_table
        total = np.zeros((len(x), layout.features))
        for corner in itertools.product((0, 1), repeat=3):
            at = cell + corner
            weight = np.prod(np.where(np.array(corner) == 1, share, 1.0 - share), axis=1)
            if is_dense:
                at = np.minimum(at, points - 1)
                entry = at[:, 0] + points * (at[:, 1] + points * at[:, 2])
            else:
                hashed = at[:, 0] ^ (at[:, 1] * _PRIMES[1]) ^ (at[:, 2] * _PRIMES[2])
                entry = hashed % (1 << layout.log2_table)
            total += weight[:, None] * table[start + entry]
        start += min(-(-(points**3) // 8) * 8, 1 << layout.log2_table) if is_dense else 1 << layout.log2_table
        parts.append(total)
    return np.concatenate(parts, axis=1)


def _hard_positions(layout: GridLayout) -> np.ndarray:
    """Random places, cell borders of every level and their neighbours in float32, faces, corners, outside."""
    rng = np.random.default_rng(0)
    random = rng.random((4000, 3))
    borders = []
    for scale in layout.scales:
        cells = rng.integers(0, max(int(scale), 1), (300, 3))
        borders.append((cells + 0.5) / scale)
    exact = np.concatenate([random, *borders]).astype(np.float32)
    around = [np.nextafter(exact[4000:], np.float32(side)) for side in (0.0, 1.0)]
    corners = np.array(list(itertools.product((0.0, 1.0, 0.5), repeat=3)), np.float32)
    outside = rng.uniform(-3.0, 4.0, (300, 3)).astype(np.float32)
    far = np.array([[math.inf, -math.inf, 0.5], [1e30, -1e30, 1e-30]], np.float32)
    return np.concatenate([exact, *around, corners, outside, far])


def _hash(layout: GridLayout) -> Reading:
    """Kernel against oracle in float32, and against float64 within eps x resolution x feature difference."""
    generator = torch.Generator().manual_seed(0)
    table = torch.rand(layout.entries, layout.features, generator=generator) * 2.0 - 1.0
    positions = torch.from_numpy(_hard_positions(layout))
    fast = hash_grid_encode(positions, table, layout)
    oracle = hash_grid_encode(positions, table, layout, backend="torch")
    beside = float((fast - oracle).abs().max()) / torch.finfo(torch.float32).eps
    exact = _plain_encode(positions.numpy(), table.numpy().astype(np.float64), layout)
    wrong = np.abs(fast.numpy() - exact).max(axis=0)
    # A position is off by half an eps, times the resolution, along three axes; features differ by up to 2.
    allowed = np.repeat([3.0 * 2.0 * (scale + 8.0) for scale in layout.scales], layout.features)
    share = float((wrong / (allowed * torch.finfo(torch.float32).eps)).max())
    return Reading(
        error=share,
        limit=1.0,
        unit="of eps x resolution x difference",
        float32="ok" if beside <= TOLERANCES[torch.float32].elementwise_ulp else "fail",
        reduced=_half_table(layout, positions, table),
        cuda=_on_cuda(
            lambda device: hash_grid_encode(positions.to(device), table.to(device), layout), oracle
        ),
        outcome=f"kernel and oracle differ by {beside:.2g} eps; box face and beyond alike",
        is_refuted=not bool(torch.isfinite(fast).all()),
    )


def _half_table(layout: GridLayout, positions: Tensor, table: Tensor) -> str:
    """Tables in half types: features are rounded, places are not."""
    notes = []
    for name, dtype in (("bf16", torch.bfloat16), ("fp16", torch.float16)):
        found = hash_grid_encode(positions, table.to(dtype), layout)
        full = hash_grid_encode(positions, table.to(dtype).float(), layout)
        error = float((found.float() - full).abs().max()) / torch.finfo(dtype).eps
        allowed = 2.0 * TOLERANCES[dtype].sum_eps
        notes.append(f"{'' if error <= allowed else 'fail: '}{name} table {error:.2g} eps")
    return "; ".join(sorted(notes, key=lambda note: not note.startswith("fail")))


def _half_positions() -> Reading:
    """Positions in half types are worked on in float32: finite, and the encoding of the rounded place."""
    layout = GridLayout(3, 2, 15, 16, 1 << 17)
    table = torch.rand(layout.entries, 2, generator=torch.Generator().manual_seed(0))
    notes, failing = [], False
    for name, dtype in (("bf16", torch.bfloat16), ("fp16", torch.float16)):
        positions = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1)).to(dtype)
        found = hash_grid_encode(positions, table, layout)
        error = float((found - hash_grid_encode(positions.float(), table, layout)).abs().max())
        failing |= not error <= 1e-5
        notes.append(f"{name} {error:.1e}")
    return Reading(reduced=("fail: " if failing else "") + "; ".join(notes))


def _on_cuda(run: Callable[[str], Tensor], oracle: Tensor) -> str:
    if not torch.cuda.is_available():
        return NOT_ON_GPU
    error = float((run("cuda").cpu() - oracle).abs().max()) / torch.finfo(torch.float32).eps
    allowed = TOLERANCES[torch.float32].elementwise_ulp
    return f"{'' if error <= allowed else 'fail: '}{error:.2g} eps beside the oracle"


def _hash_gradient() -> Reading:
    """Of table and positions, against the same formula differentiated in float64."""
    layout = GridLayout(3, 2, 12, 8, 64)
    generator = torch.Generator().manual_seed(0)
    table = (torch.rand(layout.entries, 2, generator=generator) - 0.5).requires_grad_()
    positions = torch.from_numpy(_hard_positions(layout)[:-2]).requires_grad_()
    colour = torch.rand(layout.outputs, generator=generator)
    (hash_grid_encode(positions, table, layout) * colour).sum().backward()
    wide_table = table.detach().double().requires_grad_()
    wide_positions = positions.detach().double().requires_grad_()
    (hash_grid_encode(wide_positions, wide_table, layout, backend="torch") * colour).sum().backward()
    assert table.grad is not None and wide_table.grad is not None
    assert positions.grad is not None and wide_positions.grad is not None
    error = float((table.grad.double() - wide_table.grad).abs().max() / wide_table.grad.abs().max())
    # On a border float32 and float64 may stand in neighbouring cells: either slope is right there.
    differing = (positions.grad.double() - wide_positions.grad).abs().amax(dim=1)
    inside = differing[:4000].quantile(0.99) / wide_positions.grad.abs().max()
    finite = bool(torch.isfinite(table.grad).all()) and bool(torch.isfinite(positions.grad).all())
    worst = max(error, float(inside))
    return Reading(gradient=Gradient(finite, worst, 10 * TOLERANCES[torch.float32].gradient), float32="ok")


def _hash_nan() -> Reading:
    layout = GridLayout(3, 2, 12, 8, 64)
    table = torch.rand(layout.entries, 2)
    encoded = hash_grid_encode(torch.tensor([[math.nan, 0.5, 0.5], [0.5, 0.5, 0.5]]), table, layout)
    loud = bool(encoded[0].isnan().all()) and bool(encoded[1].isfinite().all())
    return Reading(outcome="NaN encoding, its neighbours untouched", float32="ok", is_refuted=not loud)


def _far_box() -> Reading:
    """Metres to unit cube and back in a box of 200 m, 1 km from the scene's origin."""
    bounds = Bounds(centre_m=(1000.0, -1000.0, 3.0), half_m=100.0)
    rng = np.random.default_rng(0)
    points = np.array(bounds.centre_m) + rng.uniform(-100.0, 100.0, (4000, 3))
    single = torch.from_numpy(points.astype(np.float32))
    back = bounds.to_metres(bounds.to_scaled(single)).double() - single.double()
    unit = bounds.to_unit(single).double().numpy()
    exact = (single.double().numpy() - np.array(bounds.centre_m)) / 200.0 + 0.5
    wrong = np.abs(unit - exact).max() * 200.0
    return Reading(error=max(float(back.abs().max()), float(wrong)), limit=1e-3, unit="m", float32="ok")


def _plain_planes(coordinates: Tensor, plane: Tensor) -> Tensor:
    grid = (coordinates.clamp(0, 1) * 2 - 1)[None, None]
    options = {"mode": "bilinear", "padding_mode": "border", "align_corners": True}
    return torch.nn.functional.grid_sample(plane[None], grid, **options)[0, :, 0].T  # type: ignore[arg-type]


def _planes() -> Reading:
    plane = torch.rand(8, 25, 512, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    rng = np.random.default_rng(0)
    borders = rng.integers(0, 512, (500, 2)) / np.array([511.0, 24.0])
    corners = list(itertools.product((0.0, 1.0, -2.0, 3.0), repeat=2))
    places = np.concatenate([rng.random((3000, 2)), np.clip(borders, 0, 1), corners]).astype(np.float32)
    coordinates = torch.from_numpy(places)
    fast = planes_sample(coordinates, plane)
    oracle = planes_sample(coordinates, plane, backend="torch")
    exact = _plain_planes(coordinates.double(), plane.double())
    eps = torch.finfo(torch.float32).eps
    error = float((fast.double() - exact).abs().max()) / (eps * 512 * 2)
    beside = float((fast - oracle).abs().max()) / eps
    halves = []
    for name, dtype in (("bf16", torch.bfloat16), ("fp16", torch.float16)):
        rounded = coordinates.to(dtype)
        found = planes_sample(rounded, plane.to(dtype)).float()
        wrong = float((found - planes_sample(rounded.float(), plane.to(dtype).float())).abs().max())
        allowed = 4.0 * TOLERANCES[dtype].sum_eps * torch.finfo(dtype).eps
        halves.append(f"{'' if wrong <= allowed else 'fail: '}{name} {wrong:.1e}")
    return Reading(
        error=error, limit=2.0, unit="of eps x resolution x difference",
        float32="ok" if beside <= TOLERANCES[torch.float32].elementwise_ulp else "fail",
        reduced="; ".join(sorted(halves, key=lambda note: not note.startswith("fail"))),
        cuda=_on_cuda(lambda device: planes_sample(coordinates.to(device), plane.to(device)), oracle),
        outcome=f"kernel and oracle differ by {beside:.2g} eps",
    )  # fmt: skip


def _planes_gradient() -> Reading:
    generator = torch.Generator().manual_seed(0)
    plane = torch.rand(4, 9, 33, generator=generator).requires_grad_()
    coordinates = torch.rand(3000, 2, generator=generator).requires_grad_()
    planes_sample(coordinates, plane).square().sum().backward()
    wide = [x.detach().double().requires_grad_() for x in (coordinates, plane)]
    _plain_planes(*wide).square().sum().backward()
    error, finite = 0.0, True
    for single, double in zip((coordinates, plane), wide, strict=True):
        assert single.grad is not None and double.grad is not None
        finite &= bool(torch.isfinite(single.grad).all())
        error = max(error, float((single.grad.double() - double.grad).abs().max() / double.grad.abs().max()))
    return Reading(gradient=Gradient(finite, error, TOLERANCES[torch.float32].gradient), float32="ok")


def _frequency(largest: float) -> Reading:
    rng = np.random.default_rng(0)
    numbers = np.concatenate([[0.0, 0.5, 1.0, 0.25], rng.uniform(-1.0, 1.0, 400) * largest])[:, None]

    def plain(x: Tensor) -> Tensor:
        turns = [torch.remainder(x * 2.0**k, 2.0) for k in range(12)]
        parts = [f(math.pi * turn) for turn in turns for f in (torch.sin, torch.cos)]
        return torch.stack(parts, dim=-1).flatten(-2)

    # The slope is 2^k pi: its roundings count beside the steepest octave's.
    return against(
        lambda x: frequency_encode(x, 12), by_autograd(plain), [numbers], scale=1.0,
        gradient_scale=2.0**11 * math.pi, halves=(torch.bfloat16, torch.float16) if largest <= 1.0 else (),
    )  # fmt: skip


def _harmonics() -> Reading:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    poles = np.concatenate([np.eye(3), -np.eye(3)])
    exact = _plain_harmonics(np.concatenate([directions, poles]).astype(np.float32).astype(np.float64))
    found = spherical_harmonics(torch.from_numpy(np.concatenate([directions, poles]).astype(np.float32)))
    eps = torch.finfo(torch.float32).eps
    # A float32 direction is a unit vector to within an eps, and a harmonic of band 3 is a cubic of it.
    return Reading(
        error=float(np.abs(found.numpy() - exact).max()) / eps,
        limit=4 * TOLERANCES[torch.float32].elementwise_ulp, unit="eps", float32="ok", cuda=NOT_ON_GPU,
    )  # fmt: skip


def _plain_harmonics(d: np.ndarray) -> np.ndarray:
    """Real harmonics from scipy's associated Legendre functions, in float64."""
    from scipy.special import assoc_legendre_p

    polar, azimuth = np.clip(d[:, 2], -1, 1), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for band in range(4):
        for order in range(-band, band + 1):
            m = abs(order)
            norm = math.sqrt(
                (2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m)
            )
            legendre = assoc_legendre_p(band, m, polar)[0]
            turn = np.cos(m * azimuth) if order >= 0 else np.sin(m * azimuth)
            columns.append(norm * legendre * turn * (math.sqrt(2.0) if m else 1.0))
    return np.stack(columns, axis=1)


def _basis() -> Reading:
    times = np.linspace(0.0, 1.0, 2001)
    nodes = np.array([0.0, 1 / 3, 2 / 3, 1.0])
    error = max(
        abs(float(cubic_basis(float(t)).numpy() @ nodes**power) - t**power)
        for t in times
        for power in range(4)
    )
    return Reading(error=error / np.finfo(np.float64).eps, limit=TOLERANCES[torch.float64].elementwise_ulp,
                   unit="eps", float32=NOT_APPLICABLE)  # fmt: skip


_HASH = "kernels.hash_grid_encode"
_HARD = "cell borders ± 1 float, corners, faces, outside, ±inf"
CASES = (
    Case(_HASH, f"1 cm cells in a 200 m box (20,000 a side): {_HARD}", lambda: _hash(_FINE)),
    Case(_HASH, f"2^20 cells a side, the finest layout: {_HARD}", lambda: _hash(_FINEST)),
    Case(_HASH, f"gradients of table and positions: {_HARD}", _hash_gradient),
    Case(_HASH, "positions in half types, 2^17 cells a side", _half_positions),
    Case(_HASH, "NaN (outside)", _hash_nan),
    Case("geometry.bounds.Bounds", "a 200 m box 1.4 km from the origin: to the unit cube and back", _far_box),
    Case("kernels.planes_sample", "25 x 512 points: borders, corners, outside", _planes),
    Case("kernels.planes_sample", "gradients of plane and coordinates", _planes_gradient),
    Case("encodings.frequency_encode", "12 octaves, -1 to 1", lambda: _frequency(1.0)),
    Case("encodings.frequency_encode", "12 octaves, ±3.4e38", lambda: _frequency(3.4e38)),
    Case("encodings.spherical_harmonics", "the whole sphere, its poles", _harmonics),
    Case("encodings.cubic_basis", "t 0 to 1", _basis),
    Case(
        "encodings.cubic_basis", "t = 1.01, NaN (outside)",
        lambda: refused(ValueError, lambda: [cubic_basis(t) for t in (1.01, math.nan)]),
    ),
    Case(
        "kernels.planes_sample", "a plane without points (outside)",
        lambda: refused(ShapeError, lambda: planes_sample(torch.zeros(1, 2), torch.zeros(2, 0, 4))),
    ),
)  # fmt: skip
