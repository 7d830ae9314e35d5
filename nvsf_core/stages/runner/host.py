"""The machine that a figure was measured on."""

import os
import platform
from pathlib import Path

import torch


def machine() -> str:
    """Processor, cores, versions and GPU in one line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        named = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = named[0].split(":", 1)[1].strip() if named else model
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "not run on a GPU"
    return (
        f"{model}, {os.cpu_count()} CPU cores, Python {platform.python_version()}, "
        f"torch {torch.__version__}, {gpu}"
    )
