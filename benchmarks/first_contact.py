"""How long a newcomer waits: installation, the demo, and the demo again, idle and beside a busy core.

``python -m benchmarks.first_contact`` clones the checkout into a temporary folder and runs ``make install``
and ``make demo`` there, as README says; ``--busy`` keeps one core busy meanwhile; ``--installed`` takes the
present environment instead of a new one. It prints a table: seconds, lines on the terminal, and disk.
"""

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.common.places import ROOT
from nvsf_core.stages.runner.host import machine

_SPIN = "while True: pass"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--busy", action="store_true", help="keep one core busy")
    parser.add_argument("--installed", action="store_true", help="use the present environment")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="nvsf-first-") as folder:
        place = Path(folder) / "nvsf"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(place)], check=True)
        if arguments.installed:
            (place / ".venv").symlink_to(ROOT / ".venv")
        spin = subprocess.Popen(["python3", "-c", _SPIN]) if arguments.busy else None
        try:
            rows = [] if arguments.installed else [("make install", *_timed(place, "install"))]
            rows += [("make demo", *_timed(place, "demo")), ("make demo again", *_timed(place, "demo"))]
        finally:
            if spin is not None:
                spin.kill()
        print(
            f"{machine()}; {'one core busy' if arguments.busy else 'idle'}; load {os.getloadavg()[0]:.1f}\n"
        )
        print("| command | s | lines |\n| --- | ---: | ---: |")
        for name, seconds, lines in rows:
            print(f"| `{name}` | {seconds:.0f} | {lines} |")
        sizes = {name: _megabytes(place / name) for name in (".venv", ".nvsf")}
        print("\n" + ", ".join(f"{name} {size:,.0f} MB" for name, size in sizes.items()))


def _timed(place: Path, target: str) -> tuple[float, int]:
    """Seconds and printed lines of a make target.

    Raises:
        CalledProcessError: It failed.
    """
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("NVSF_", "DAGSTER_"))
    }
    # Stamps younger than what they depend on: a clone's files are as old as the clone.
    for stamp in (place / ".venv").glob(".installed*"):
        stamp.touch()
    started = time.perf_counter()
    done = subprocess.run(
        ["make", target], cwd=place, env=environment, check=True, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )  # fmt: skip
    lines = [line for line in done.stdout.splitlines() if "pypi" not in line]
    return time.perf_counter() - started, len(lines)


def _megabytes(folder: Path) -> float:
    if shutil.which("du") is None or not folder.exists():
        return float("nan")
    done = subprocess.run(["du", "-smL", str(folder)], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0])


if __name__ == "__main__":
    main()
