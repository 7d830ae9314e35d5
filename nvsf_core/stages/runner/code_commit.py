"""The version of this project's code that made something."""

import subprocess
from functools import cache
from pathlib import Path


@cache
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
