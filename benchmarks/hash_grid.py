"""Speed and error of the numba hash grid beside the torch oracle, forward and adjoint.

    python -m benchmarks.hash_grid [--points 131072] [--repeats 5]
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from pathlib import Path

import numba
import torch
from torch import Tensor

from nvsf_core.kernels import Backend, GridLayout, hash_grid_encode

LAYOUTS = {
    "8 levels, F 2, T 2^17, 16..2048": GridLayout(8, 2, 17, 16, 2048),
    "8 levels, F 4, T 2^19, 16..2048": GridLayout(8, 4, 19, 16, 2048),
    "paper: 8 levels, F 4, T 2^19, 512..32768": GridLayout(8, 4, 19, 512, 32768),
}


def _machine() -> str:
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = models[0] if models else model
    return (
        f"{model}, {os.cpu_count()} cores, {torch.get_num_threads()} threads, Python {platform.python_version()}, "
        f"torch {torch.__version__}, numba {numba.__version__}"
    )


def _run(backend: Backend, positions: Tensor, table: Tensor, layout: GridLayout, cotangent: Tensor) -> tuple[float, float]:
    start = time.perf_counter()
    encoded = hash_grid_encode(positions, table, layout, backend=backend)
    middle = time.perf_counter()
    table.grad = None
    encoded.backward(cotangent)
    return middle - start, time.perf_counter() - middle


def _compare(name: str, layout: GridLayout, points: int, repeats: int) -> None:
    generator = torch.Generator().manual_seed(0)
    # runs of neighbouring samples, as rays make them
    starts = torch.rand(points // 32, 1, 3, generator=generator)
    steps = torch.linspace(0, 0.05, 32)[None, :, None] * torch.randn(points // 32, 1, 3, generator=generator)
    positions = (starts + steps).reshape(-1, 3)
    table = torch.empty(layout.entries, layout.features).uniform_(-1, 1, generator=generator).requires_grad_()
    cotangent = torch.randn(positions.shape[0], layout.outputs, generator=generator)

    rates: dict[str, tuple[float, float, float]] = {}
    gradients: dict[str, Tensor] = {}
    backends: tuple[Backend, ...] = ("torch", "numba")
    for backend in backends:
        times = [_run(backend, positions, table, layout, cotangent) for _ in range(repeats + 1)][1:]
        forward, adjoint = (min(column) for column in zip(*times, strict=True))
        both = min(sum(pair) for pair in times)
        rates[backend] = tuple(positions.shape[0] / seconds / 1e6 for seconds in (forward, adjoint, both))  # type: ignore[assignment]
        assert table.grad is not None
        gradients[backend] = table.grad
    with torch.no_grad():
        truth = hash_grid_encode(positions, table, layout, backend="torch")
        value_error = (hash_grid_encode(positions, table, layout, backend="numba") - truth).abs().max().item()
    scale = gradients["torch"].abs().max()
    gradient_error = ((gradients["numba"] - gradients["torch"]).abs().max() / scale).item()
    for backend in backends:
        errors = (0.0, 0.0) if backend == "torch" else (value_error, gradient_error)
        forward, adjoint, both = rates[backend]
        print(
            f"| {name} | {backend} | {forward:.2f} | {adjoint:.2f} | {both:.3f} | {both / rates['torch'][2]:.1f} "
            f"| {errors[0]:.1e} | {errors[1]:.1e} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1 << 17)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(f"machine: {_machine()}")
    print(f"{arguments.points} points a call, best of {arguments.repeats}; M points/s; error against the oracle")
    print("(value: largest difference for entries in +-1; gradient: largest difference / largest gradient)\n")
    print("| grid | backend | forward | adjoint | both | times the oracle | value error | gradient error |")
    print("|---|---|---|---|---|---|---|---|")
    for name, layout in LAYOUTS.items():
        _compare(name, layout, arguments.points, arguments.repeats)


if __name__ == "__main__":
    main()
