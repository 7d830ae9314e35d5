"""Laws of the hash grid's Triton kernels: on the CPU by Triton's interpreter, on CUDA where there is one."""

import importlib.util
import itertools
import math
import sys

import pytest
import torch

from nvsf_core.errors import ShapeError
from nvsf_core.kernels.encodings.hash_grid import GridLayout, hash_grid_encode

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed here"
)
on_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

PAPER = GridLayout(levels=8, features=4, log2_table=19, base_resolution=512, finest_resolution=32768)


def _layout(dimensions, features, finest=50):
    """In 3-D one dense level and two hashed ones, in 2-D the other way round."""
    return GridLayout(
        levels=3, features=features, log2_table=9, base_resolution=5, finest_resolution=finest,
        dimensions=dimensions,
    )  # fmt: skip


def _table(layout, device="cpu"):
    generator = torch.Generator().manual_seed(0)
    return torch.empty(layout.entries, layout.features).uniform_(-1, 1, generator=generator).to(device)


def _moved_by_fusion(scale):
    """Coordinates near a cell border whose cell changes if x * scale + 0.5 is rounded once, not twice."""
    scale = torch.tensor(scale, dtype=torch.float32)
    border = ((torch.arange(scale.item()) + 0.5) / scale).float()
    near = torch.cat([border, border.nextafter(torch.tensor(0.0)), border.nextafter(torch.tensor(1.0))])
    rounded_once = (near.double() * scale.double() + 0.5).float()
    return near[(near * scale + 0.5).floor() != rounded_once.floor()]


def _hard_positions(layout):
    """Cell borders, corners of the box, outside of it, infinities, NaN along each axis; over one block."""
    generator = torch.Generator().manual_seed(1)
    axes = layout.dimensions
    lines = torch.cat([(torch.arange(s) + 0.5) / s for s in layout.scales] + [torch.tensor([0.0, 1.0])])
    moved = torch.cat([_moved_by_fusion(scale) for scale in layout.scales])
    with_nan = torch.rand(axes, axes, generator=generator).fill_diagonal_(math.nan)
    return torch.cat(
        [
            lines[torch.randint(len(lines), (60, axes), generator=generator)],
            moved[:, None].expand(-1, axes),
            torch.tensor(list(itertools.product([0.0, 1.0], repeat=axes))),
            torch.randn(30, axes, generator=generator) * 3,
            torch.full((1, axes), math.inf),
            torch.full((1, axes), -math.inf),
            torch.full((1, axes), -0.0),
            with_nan,
        ]
    )


def _value_and_gradients(positions, table, layout, backend):
    positions, table = positions.detach().requires_grad_(), table.detach().requires_grad_()
    encoded = hash_grid_encode(positions, table, layout, backend=backend)
    cotangent = torch.randn(encoded.shape, generator=torch.Generator().manual_seed(3)).to(encoded)
    encoded.backward(cotangent)
    return encoded.detach(), table.grad, positions.grad


def _assert_equal_to_the_oracle(positions, table, layout):
    found = _value_and_gradients(positions, table, layout, "triton")
    for value, expected in zip(found, _value_and_gradients(positions, table, layout, "torch"), strict=True):
        known = expected[expected.isfinite()]
        largest = max(1.0, known.abs().max().item()) if known.numel() else 1.0
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6 * largest, equal_nan=True)


@pytest.mark.parametrize(
    ("dimensions", "features"), [(2, 1), (2, 3), (2, 4), (3, 1), (3, 2), (3, 4), (3, 8)], ids=str
)
def test_triton_equals_the_oracle_on_hard_inputs(device, dimensions, features):
    layout = _layout(dimensions, features)
    _assert_equal_to_the_oracle(_hard_positions(layout).to(device), _table(layout, device), layout)


@pytest.mark.parametrize("points", [0, 1, 128])
def test_triton_equals_the_oracle_for_any_number_of_points(device, points):
    layout = _layout(3, 2, finest=32768)
    positions = torch.rand(points, 3, generator=torch.Generator().manual_seed(2)).to(device)
    _assert_equal_to_the_oracle(positions, _table(layout, device), layout)


def test_a_fused_multiply_add_would_move_a_hard_position_to_another_cell():
    assert sum(len(_moved_by_fusion(scale)) for scale in _layout(3, 2).scales) > 0


def test_code_compiled_for_cuda_fuses_no_multiply_with_an_add():
    kernels = _compilable_kernels()
    names = ("_forward", "_table_adjoint", "_position_adjoint")
    assert [_fused_in(getattr(kernels, name), fusion=False) for name in names] == [0, 0, 0]
    # so it is the option that keeps them apart
    assert _fused_in(kernels._forward, fusion=True) > 0


def _compilable_kernels():
    """The kernels' module once more, for the compiler: where there is no CUDA the other is interpreted."""
    name = "nvsf_core.kernels.encodings.hash_grid_triton"
    spec = importlib.util.find_spec(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _fused_in(kernel, fusion):
    """Fused multiply-adds in a kernel compiled as for the paper's grid on compute capability 8.9."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    constants = {"LEVELS": 8, "DIMENSIONS": 3, "FEATURES": 4, "WIDTH": 4, "BLOCK": 128}
    types = {"points": "i32", "entry_mask": "i32", "resolutions": "*i32", "dense": "*i32", "offsets": "*i64"}
    signature = {n: "constexpr" if n in constants else types.get(n, "*fp32") for n in kernel.arg_names}
    compiled = triton.compile(
        ASTSource(kernel, signature, constants),
        target=GPUTarget("cuda", 89, 32),
        options={"enable_fp_fusion": fusion},
    )
    assert compiled.asm["cubin"]
    return compiled.asm["ptx"].count("fma.")


def test_views_that_are_not_contiguous_are_encoded_alike(device):
    layout = _layout(2, 2)
    positions, table = _hard_positions(layout)[:50].to(device), _table(layout, device)
    apart = hash_grid_encode(
        positions.t().contiguous().t(), table.t().contiguous().t(), layout, backend="triton"
    )
    assert torch.equal(apart, hash_grid_encode(positions, table, layout, backend="triton"))


def test_other_types_than_float32_are_refused(device):
    layout = _layout(2, 1)
    with pytest.raises(ShapeError, match="the triton backend expects float32"):
        hash_grid_encode(
            torch.zeros(4, 2, device=device).double(), _table(layout, device), layout, backend="triton"
        )


def test_the_cpu_needs_no_triton(monkeypatch):
    monkeypatch.setitem(sys.modules, "triton", None)
    monkeypatch.setitem(sys.modules, "nvsf_core.kernels.encodings.hash_grid_triton", None)
    monkeypatch.delattr("nvsf_core.kernels.encodings.hash_grid_triton", raising=False)
    layout = _layout(3, 2)
    table = _table(layout).requires_grad_()
    hash_grid_encode(torch.zeros(4, 3, requires_grad=True), table, layout).sum().backward()
    assert table.grad.sum().item() == pytest.approx(4 * layout.outputs)
    with pytest.raises(ImportError):
        hash_grid_encode(torch.zeros(4, 3), table, layout, backend="triton")


@on_cuda
def test_cuda_encodes_with_triton_as_the_oracle_does_at_the_papers_size():
    positions = torch.rand(100_000, 3, generator=torch.Generator().manual_seed(4)).cuda()
    table = _table(PAPER, "cuda")
    _assert_equal_to_the_oracle(positions, table, PAPER)
    encoded = hash_grid_encode(positions, table.requires_grad_(), PAPER)
    assert encoded.grad_fn.kernels.backend == "triton"


@on_cuda
def test_ten_million_points_on_cuda():
    generator = torch.Generator("cuda").manual_seed(5)
    positions = torch.rand(10_000_000, 3, generator=generator, device="cuda")
    table = _table(PAPER, "cuda")
    sample = torch.randint(len(positions), (100_000,), generator=generator, device="cuda")
    whole = hash_grid_encode(positions, table, PAPER)
    for first in range(0, len(positions), 3_000_017):
        part = slice(first, first + 3_000_017)
        assert torch.equal(hash_grid_encode(positions[part], table, PAPER), whole[part])
    expected = hash_grid_encode(positions[sample], table, PAPER, backend="torch")
    torch.testing.assert_close(whole[sample], expected, rtol=1e-5, atol=1e-6)
