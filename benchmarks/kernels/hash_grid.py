"""Speed and error of the numba hash grid beside the torch oracle, forward and adjoint.

Run ``python -m benchmarks.kernels.hash_grid [--points 131072] [--repeats 15]`` on an otherwise idle machine.
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

from nvsf_core.encodings import HashGrid
from nvsf_core.kernels import Backend, GridLayout, hash_grid_encode

LAYOUTS = {
    "8 levels, F 2, T 2^17, 16..2048": GridLayout(8, 2, 17, 16, 2048),
    "8 levels, F 4, T 2^19, 16..2048": GridLayout(8, 4, 19, 16, 2048),
    "paper: 8 levels, F 4, T 2^19, 512..32768": GridLayout(8, 4, 19, 512, 32768),
}
SAMPLES_PER_RAY = 32


def _machine() -> str:
    """Processor, cores, threads and versions in one line."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        named = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = named[0].split(":", 1)[1].strip() if named else model
    return (
        f"{model}, {os.cpu_count()} cores, {torch.get_num_threads()} threads, "
        f"Python {platform.python_version()}, torch {torch.__version__}, numba {numba.__version__}"
    )


def samples_on_rays(points: int, generator: torch.Generator) -> Tensor:
    """Positions in runs of near neighbours, as rays make them."""
    rays = points // SAMPLES_PER_RAY
    origins = torch.rand(rays, 1, 3, generator=generator)
    directions = torch.randn(rays, 1, 3, generator=generator)
    return (origins + torch.linspace(0, 0.05, SAMPLES_PER_RAY)[:, None] * directions).reshape(-1, 3)


def _seconds(
    backend: Backend, positions: Tensor, table: Tensor, layout: GridLayout, cotangent: Tensor
) -> tuple[float, float]:
    """Wall time of one forward and one adjoint."""
    table.grad = None
    start = time.perf_counter()
    encoded = hash_grid_encode(positions, table, layout, backend=backend)
    middle = time.perf_counter()
    encoded.backward(cotangent)
    return middle - start, time.perf_counter() - middle


def _compare(name: str, layout: GridLayout, points: int, repeats: int) -> None:
    generator = torch.Generator().manual_seed(0)
    positions = samples_on_rays(points, generator)
    table = HashGrid(layout, generator).table
    with torch.no_grad():
        table.mul_(1e4)
    cotangent = torch.randn(positions.shape[0], layout.outputs, generator=generator)
    oracle_rate, oracle_value, oracle_gradient = 0.0, None, None
    backends: tuple[Backend, ...] = ("torch", "numba")
    for backend in backends:
        _seconds(backend, positions, table, layout, cotangent)  # compiles, warms
        times = [_seconds(backend, positions, table, layout, cotangent) for _ in range(repeats)]
        forward, adjoint = (positions.shape[0] / min(column) / 1e6 for column in zip(*times, strict=True))
        both = positions.shape[0] / min(sum(pair) for pair in times) / 1e6
        with torch.no_grad():
            value = hash_grid_encode(positions, table, layout, backend=backend)
        gradient = table.grad
        assert gradient is not None
        if oracle_value is None or oracle_gradient is None:
            oracle_rate, oracle_value, oracle_gradient = both, value, gradient
        value_error = (value - oracle_value).abs().max().item()
        gradient_error = ((gradient - oracle_gradient).abs().max() / oracle_gradient.abs().max()).item()
        print(
            f"| {name} | {backend} | {forward:.2f} | {adjoint:.2f} | {both:.2f} | {both / oracle_rate:.1f} "
            f"| {value_error:.1e} | {gradient_error:.1e} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1 << 17)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    print(f"machine: {_machine()}")
    print(f"{arguments.points} points a call, best of {arguments.repeats}; million points a second.")
    print("Value error: largest difference to the oracle, entries in +-1;")
    print("gradient error: largest difference / largest gradient.\n")
    print("| grid | backend | forward | adjoint | both | times the oracle | value error | gradient error |")
    print("|---|---|---|---|---|---|---|---|")
    for name, layout in LAYOUTS.items():
        _compare(name, layout, arguments.points, arguments.repeats)


if __name__ == "__main__":
    main()
