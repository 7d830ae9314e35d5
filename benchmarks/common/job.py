"""Dagster's job ``benchmark`` in a process of its own, as a user starts it."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path


def execute_benchmark(chosen: Mapping[str, str]) -> int:
    """Run the job with these variables (SCENES, RECIPE, ...) over our own; returns its exit code."""
    dagster = Path(sys.executable).parent / "dagster"
    environment = os.environ | {"DAGSTER_MODULE_NAME": "pipelines.definitions"} | chosen
    done = subprocess.run([dagster, "job", "execute", "-j", "benchmark"], env=environment, check=False)
    return abs(done.returncode)
