"""How long a newcomer waits: installation, the demo, and the demo again, idle and beside a busy core.

``python -m benchmarks.first_contact`` clones the checkout into a temporary folder and runs ``make install``
and ``make demo`` there, as README says; ``--busy`` keeps one core busy meanwhile; ``--installed`` runs the
demo of this checkout instead. It prints a table: seconds, lines on the terminal, and disk.
"""

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.common.documents import ROOT
from nvsf_core.stages.runner.host import machine

_SPIN = "while True: pass"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--busy", action="store_true", help="keep one core busy")
    parser.add_argument("--installed", action="store_true", help="use the present environment")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="nvsf-first-") as folder:
        place = ROOT
        if not arguments.installed:
            place = Path(folder) / "nvsf"
            subprocess.run(["git", "clone", "--quiet", str(ROOT), str(place)], check=True)
        home = Path(folder) / "home"
        spin = subprocess.Popen(["python3", "-c", _SPIN]) if arguments.busy else None
        try:
            rows = [] if arguments.installed else [("make install", *_timed(place, home, "install"))]
            rows += [(name, *_timed(place, home, "demo")) for name in ("make demo", "make demo again")]
        finally:
            if spin is not None:
                spin.kill()
        print(
            f"{machine()}; {'one core busy' if arguments.busy else 'idle'}; load {os.getloadavg()[0]:.1f}\n"
        )
        print("| command | s | lines |\n| --- | ---: | ---: |")
        for name, seconds, lines in rows:
            print(f"| `{name}` | {seconds:.0f} | {lines} |")
        print(f"\n.venv {_megabytes(place / '.venv'):,.0f} MB, outputs {_megabytes(home):,.0f} MB")


def _timed(place: Path, home: Path, target: str) -> tuple[float, int]:
    """Seconds and printed lines of a make target.

    Raises:
        CalledProcessError: It failed.
    """
    names = [name for name in os.environ if not name.startswith(("NVSF_", "DAGSTER_"))]
    environment = {name: os.environ[name] for name in names} | {"NVSF_HOME": str(home)}
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
