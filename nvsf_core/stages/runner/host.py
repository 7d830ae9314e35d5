"""The machine and the commit that a figure was measured on."""

import os
import platform
import subprocess
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


def code_commit() -> str:
    """Git commit of this code; `unknown` outside a checkout."""
    folder = Path(__file__).resolve().parent
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
        )
    except OSError:
        return "unknown"
    return done.stdout.strip() if done.returncode == 0 else "unknown"
