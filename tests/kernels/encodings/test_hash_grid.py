"""Laws of the hash-grid encode: the oracle against its definition, numba against the oracle."""

import itertools
import math
import subprocess
import sys
from functools import reduce
from operator import xor

import numba
import pytest
import torch

from nvsf_core.errors import RecipeError, ShapeError
from nvsf_core.kernels.encodings.hash_grid import GridLayout, hash_grid_encode

# Three dense levels (4, 8, 16 points an axis) and two hashed ones (32, 64).
MIXED = GridLayout(levels=5, features=2, log2_table=12, base_resolution=4, finest_resolution=64)
LAYOUTS = [
    MIXED,
    GridLayout(levels=1, features=1, log2_table=10, base_resolution=5, finest_resolution=5),
    GridLayout(levels=4, features=4, log2_table=9, base_resolution=512, finest_resolution=32768),
    # In two dimensions: four dense levels (16 to 2304 points) and a hashed one (96).
    GridLayout(levels=5, features=2, log2_table=12, base_resolution=4, finest_resolution=96, dimensions=2),
    GridLayout(
        levels=3, features=2, log2_table=8, base_resolution=512, finest_resolution=32768, dimensions=2
    ),
]
MOST = numba.config.NUMBA_NUM_THREADS


def _table(layout, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return torch.empty(layout.entries, layout.features, dtype=dtype).uniform_(-1, 1, generator=generator)


def _positions(kind, dimensions=3):
    return _positions_in_space(kind)[:, :dimensions]


def _positions_in_space(kind):
    generator = torch.Generator().manual_seed(1)
    if kind == "random":
        return torch.rand(5003, 3, generator=generator)
    if kind == "corners":
        return torch.tensor(list(itertools.product([0.0, 1.0], repeat=3)))
    if kind == "cell borders":
        # where x * scale + 0.5 is whole in the levels of 4, 8, 16, 32 and 64 points
        lines = torch.cat([(torch.arange(n) + 0.5) / (n - 1) for n in (4, 8, 16, 32, 64)]).clamp(0, 1)
        return lines[torch.randint(len(lines), (3000, 3), generator=generator)]
    if kind == "outside":
        far = torch.tensor([[-math.inf, 0.5, 0.5], [0.2, math.inf, 1e30], [-1e30, 0.3, -0.0]])
        return torch.cat([torch.randn(500, 3, generator=generator) * 3, far])
    if kind == "none":
        return torch.zeros(0, 3)
    if kind == "a NaN on each axis":
        positions = torch.rand(700, 3, generator=generator)
        positions[[3, 300, 699], [0, 1, 2]] = math.nan
        return positions
    if kind == "whole blocks":
        return torch.rand(512, 3, generator=generator)
    return torch.tensor([[0.3, 0.6, 0.9]])


KINDS = ["random", "corners", "cell borders", "outside", "a NaN on each axis", "whole blocks", "none", "one"]


def _encode_by_hand(position, table, layout):
    """The definition, one number at a time."""
    out = []
    for level in range(layout.levels):
        size = layout.offsets[level + 1] - layout.offsets[level]
        resolution = layout.resolutions[level]
        grid = [min(max(p, 0.0), 1.0) * layout.scales[level] + 0.5 for p in position]
        total = [0.0] * layout.features
        for step in itertools.product([0, 1], repeat=layout.dimensions):
            point = [math.floor(g) + s for g, s in zip(grid, step, strict=True)]
            weight = math.prod(
                g - math.floor(g) if s else 1 - (g - math.floor(g)) for g, s in zip(grid, step, strict=True)
            )
            if resolution**layout.dimensions <= size:
                index = sum(min(c, resolution - 1) * resolution**axis for axis, c in enumerate(point))
            else:
                factors = (1, 2654435761, 805459861)[: layout.dimensions]
                index = reduce(xor, (c * f for c, f in zip(point, factors, strict=True))) % size
            row = table[layout.offsets[level] + index].tolist()
            total = [t + weight * r for t, r in zip(total, row, strict=True)]
        out += total
    return out


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_oracle_is_its_definition(layout):
    table = _table(layout, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    positions = torch.rand(20, layout.dimensions, dtype=torch.float64, generator=generator) * 1.2 - 0.1
    by_hand = torch.tensor([_encode_by_hand(p.tolist(), table, layout) for p in positions]).double()
    assert torch.allclose(hash_grid_encode(positions, table, layout), by_hand, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_numba_equals_the_oracle(layout, kind):
    positions = _positions(kind, layout.dimensions)
    cotangent = torch.randn(len(positions), layout.outputs, generator=torch.Generator().manual_seed(3))
    values, gradients = [], []
    for backend in ("torch", "numba"):
        table = _table(layout).requires_grad_()
        encoded = hash_grid_encode(positions, table, layout, backend=backend)
        encoded.backward(cotangent)
        values.append(encoded.detach())
        gradients.append(table.grad)
    assert values[0].shape == (len(positions), layout.outputs)
    torch.testing.assert_close(values[1], values[0], rtol=1e-5, atol=1e-6, equal_nan=True)
    largest = max(1.0, gradients[0].nan_to_num(0.0).abs().max().item())
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-5, atol=1e-6 * largest, equal_nan=True)


def test_the_adjoint_is_the_transpose_of_the_forward_pass():
    positions = _positions("random")
    table = _table(MIXED).requires_grad_()
    other = _table(MIXED, seed=9)
    cotangent = torch.randn(len(positions), MIXED.outputs, generator=torch.Generator().manual_seed(4))
    hash_grid_encode(positions, table, MIXED).backward(cotangent)
    forward = (hash_grid_encode(positions, other, MIXED).double() * cotangent).sum()
    assert forward.item() == pytest.approx((other.double() * table.grad).sum().item(), rel=1e-4)


@pytest.mark.parametrize("layout", [MIXED, LAYOUTS[3]], ids=["space", "square"])
def test_the_same_bits_for_every_run_and_thread_count(layout):
    positions = _positions("random", layout.dimensions)
    cotangent = torch.randn(len(positions), layout.outputs, generator=torch.Generator().manual_seed(5))
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, MOST, MOST):
            numba.set_num_threads(threads)
            table = _table(layout).requires_grad_()
            encoded = hash_grid_encode(positions, table, layout, backend="numba")
            encoded.backward(cotangent)
            results.append((encoded.detach(), table.grad))
    finally:
        numba.set_num_threads(before)
    for encoded, gradient in results[1:]:
        assert torch.equal(encoded, results[0][0])
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_oracle_passes_gradcheck_in_table_and_positions(dimensions):
    layout = GridLayout(2, 2, log2_table=6, base_resolution=3, finest_resolution=9, dimensions=dimensions)
    positions = (
        torch.rand(5, dimensions, dtype=torch.float64, generator=torch.Generator().manual_seed(6)) * 0.9
        + 0.05
    )
    table = _table(layout, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, t: hash_grid_encode(p, t, layout), (positions.requires_grad_(), table)
    )


def test_numba_hands_positions_the_gradient_of_the_oracle():
    gradients = []
    for backend in ("torch", "numba"):
        positions = _positions("outside")[:500].requires_grad_()
        hash_grid_encode(positions, _table(MIXED), MIXED, backend=backend).square().sum().backward()
        gradients.append(positions.grad)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-4)
    outside = (_positions("outside")[:500] < 0) | (_positions("outside")[:500] > 1)
    assert (gradients[1][outside] == 0).all()


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_outside_the_box_is_the_nearest_point_of_the_box(backend):
    positions = _positions("outside")
    table = _table(MIXED)
    clamped = hash_grid_encode(positions.clamp(0, 1), table, MIXED, backend=backend)
    assert torch.equal(hash_grid_encode(positions, table, MIXED, backend=backend), clamped)


@pytest.mark.parametrize("backend", ["torch", "numba"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_nan_position_stays_nan_and_alone(backend, axis):
    positions = _positions("random")[:7].clone()
    positions[3, axis] = math.nan
    encoded = hash_grid_encode(positions, _table(MIXED), MIXED, backend=backend)
    assert torch.isnan(encoded).all(dim=1).tolist() == [False, False, False, True, False, False, False]


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_constant_table_encodes_as_that_constant(backend):
    encoded = hash_grid_encode(
        _positions("random"), torch.full((MIXED.entries, MIXED.features), 0.75), MIXED, backend=backend
    )
    assert (encoded - 0.75).abs().max() < 1e-6


def test_views_that_are_not_contiguous_are_encoded_alike():
    positions = _positions("random")
    table = _table(MIXED)
    assert torch.equal(
        hash_grid_encode(positions.t().contiguous().t(), table.t().contiguous().t(), MIXED),
        hash_grid_encode(positions, table, MIXED),
    )


def test_the_papers_levels():
    layout = GridLayout(levels=8, features=4, log2_table=19, base_resolution=512, finest_resolution=32768)
    assert layout.resolutions == (512, 928, 1681, 3044, 5513, 9987, 18090, 32768)
    assert not any(layout.is_dense)
    assert layout.entries * layout.features == 16_777_216


def test_a_plane_is_dense_where_the_square_of_its_points_fits():
    layout = LAYOUTS[3]
    assert layout.resolutions == (4, 9, 20, 44, 96)
    assert layout.is_dense == (True, True, True, True, False)
    assert layout.offsets == (0, 16, 16 + 88, 104 + 400, 504 + 1936, 2440 + 4096)


def test_a_dense_level_has_its_points_rounded_up_to_eight_entries():
    assert MIXED.is_dense == (True, True, True, False, False)
    assert MIXED.offsets == (0, 64, 64 + 512, 64 + 512 + 4096, 576 + 2 * 4096, 576 + 3 * 4096)


@pytest.mark.parametrize(
    "change",
    [{"levels": 0}, {"features": 0}, {"log2_table": 40}, {"finest_resolution": 3}, {"dimensions": 4}],
)
def test_an_impossible_layout_is_refused(change):
    values = {
        "levels": 2,
        "features": 2,
        "log2_table": 8,
        "base_resolution": 4,
        "finest_resolution": 8,
    } | change
    with pytest.raises(RecipeError, match=next(iter(change))):
        GridLayout(**values)


def test_wrong_shapes_and_types_are_refused():
    table = _table(MIXED)
    with pytest.raises(ShapeError, match=r"\(n, 3\)"):
        hash_grid_encode(torch.zeros(4, 2), table, MIXED)
    with pytest.raises(ShapeError, match=r"\(n, 2\)"):
        hash_grid_encode(torch.zeros(4, 3), _table(LAYOUTS[3]), LAYOUTS[3])
    with pytest.raises(ShapeError, match="expected a table"):
        hash_grid_encode(torch.zeros(4, 3), table[:-1], MIXED)
    with pytest.raises(ShapeError, match="float32"):
        hash_grid_encode(torch.zeros(4, 3).double(), table, MIXED, backend="numba")


def test_importing_the_kernels_does_not_import_numba():
    code = "import sys, nvsf_core.kernels; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
