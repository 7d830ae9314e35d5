"""Times of the encodings' Triton kernels, beside the limit by memory bandwidth; and their errors."""

import os
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from itertools import pairwise
from statistics import median

import torch
from torch import Tensor

from benchmarks.common.documents import Row
from benchmarks.gpu.plan import Plan
from nvsf_core.kernels.encodings.hash_grid import GridLayout, HashGrid, hash_grid_encode
from nvsf_core.kernels.encodings.planes import planes_sample

_COPIED = 1 << 30
"""Bytes of the copy that the bandwidth is measured by, on a GPU."""
_PLANE = (8, 256, 256)
"""Of the paper's finest scale: features, rows, columns."""
_SAMPLES_PER_RAY = 32


def kernel_rows(plan: Plan) -> list[Row]:
    """A row a kernel and grid; none without Triton.

    The least bytes: each input read once, each output written once, of the table at most what is looked up.
    """
    if find_spec("triton") is None:
        return []
    is_cuda = torch.cuda.is_available()
    if not is_cuda:
        os.environ["TRITON_INTERPRET"] = "1"  # before the kernels are imported
    device = torch.device("cuda" if is_cuda else "cpu")
    source = torch.randint(255, (_COPIED if is_cuda else 1 << 20,), dtype=torch.uint8, device=device)
    copy = torch.empty_like(source)
    bytes_per_s = 2 * source.numel() / _seconds(lambda: copy.copy_(source), plan.repeats)
    rows: list[Row] = []
    generator = torch.Generator().manual_seed(0)
    points = samples_on_rays(plan.points, generator).clamp_(0.0, 1.0)
    for name, layout in plan.layouts.items():
        table = HashGrid(layout, generator).table.detach() * 1e4
        oracle = _oracle(points, table, lambda x, t, of=layout: hash_grid_encode(x, t, of, backend="torch"))
        calls = _hash_calls(points.to(device), table.to(device), layout)
        for (kernel, call, least_bytes), truth in zip(calls, oracle, strict=True):
            rows.append(_row(f"hash grid, {name}", kernel, call, truth, least_bytes, bytes_per_s, plan))
    plane = torch.rand(_PLANE, generator=generator) * 2.0 - 1.0
    flat = points[:, :2].contiguous()
    oracle = _oracle(flat, plane, lambda x, t: planes_sample(x, t, backend="torch"))
    for (kernel, call, least_bytes), truth in zip(
        _plane_calls(flat.to(device), plane.to(device)), oracle, strict=True
    ):
        rows.append(_row("plane, 8 x 256 x 256", kernel, call, truth, least_bytes, bytes_per_s, plan))
    return rows


def samples_on_rays(points: int, generator: torch.Generator) -> Tensor:
    """Positions (points, 3) in runs of near neighbours, as rays make them; `points` a multiple of 32."""
    rays = points // _SAMPLES_PER_RAY
    origins = torch.rand(rays, 1, 3, generator=generator)
    directions = torch.randn(rays, 1, 3, generator=generator)
    return (origins + torch.linspace(0, 0.05, _SAMPLES_PER_RAY)[:, None] * directions).reshape(-1, 3)


Call = tuple[str, Callable[[], Tensor], int]
"""A kernel's name, a call of it, and the least bytes that it moves."""


def _hash_calls(points: Tensor, table: Tensor, layout: GridLayout) -> Iterator[Call]:
    from nvsf_core.kernels.encodings import hash_grid_triton as kernels

    grad = torch.ones(len(points), layout.outputs, device=points.device)
    looked_up = min(table.numel(), len(points) * layout.outputs << layout.dimensions) * 4
    io = (points.numel() + grad.numel()) * 4
    yield "forward", lambda: kernels.encode(points, table, layout), io + looked_up
    yield (
        "to the points",
        lambda: kernels.position_adjoint(points, table, grad, layout),
        (io + looked_up + points.numel() * 4),
    )
    yield "to the table", lambda: kernels.adjoint(points, grad, layout), io + table.numel() * 4


def _plane_calls(points: Tensor, plane: Tensor) -> Iterator[Call]:
    from nvsf_core.kernels.encodings import planes_triton as kernels

    grad = torch.ones(len(points), len(plane), device=points.device)
    least = (points.numel() + grad.numel() + plane.numel()) * 4
    yield "forward", lambda: kernels.sample(points, plane), least
    yield "to the points", lambda: kernels.coordinate_adjoint(points, plane, grad), least + points.numel() * 4
    yield "to the table", lambda: kernels.adjoint(points, grad, plane.shape), least


def _oracle(points: Tensor, table: Tensor, encode: Callable[[Tensor, Tensor], Tensor]) -> list[Tensor]:
    """What torch on the CPU finds: values, gradients by points and by table of their sum."""
    points, table = points.detach().requires_grad_(), table.detach().requires_grad_()
    found = encode(points, table)
    found.sum().backward()
    assert points.grad is not None and table.grad is not None
    return [found.detach(), points.grad, table.grad]


def _row(
    grid: str, kernel: str, call: Callable[[], Tensor], truth: Tensor, least_bytes: int, bytes_per_s: float,
    plan: Plan,
) -> Row:  # fmt: skip
    error = (call().cpu() - truth).abs().max().item() / truth.abs().max().item()
    seconds, least_s = _seconds(call, plan.repeats), least_bytes / bytes_per_s
    return {
        "grid": grid, "kernel": kernel, "points": plan.points, "ms": seconds * 1e3, "least_ms": least_s * 1e3,
        "gb_per_s": bytes_per_s / 1e9, "relative_error": error,
    }  # fmt: skip


def _seconds(call: Callable[[], object], repeats: int) -> float:
    """Median of calls, kernels loaded; by the device's own clock where it has one."""
    for _ in range(min(3, repeats)):
        call()
    if not torch.cuda.is_available():
        clock = [time.perf_counter()]
        for _ in range(repeats):
            call()
            clock.append(time.perf_counter())
        return median(b - a for a, b in pairwise(clock))
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(repeats + 1)]
    marks[0].record()
    for mark in marks[1:]:
        call()
        mark.record()
    torch.cuda.synchronize()
    return median(a.elapsed_time(b) for a, b in pairwise(marks)) / 1e3
