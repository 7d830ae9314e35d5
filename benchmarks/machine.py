"""What a figure was measured on: the machine and the commit."""

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


def commit() -> str:
    """Short commit of this checkout; `unknown` outside one."""
    folder = Path(__file__).resolve().parent
    done = subprocess.run(
        ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() if done.returncode == 0 else "unknown"
