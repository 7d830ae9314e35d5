"""The commit that a figure was measured at."""

import subprocess
from pathlib import Path


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
