"""Measure this project on a machine with a GPU, and write docs/gpu.md: ``python -m benchmarks.gpu``.

Without a GPU it says what it would do. ``--smoke`` does all of it tiny, on the CPU too, into ``--to``.
``NVSF_SCENES`` and ``NVSF_HOME`` as in a training; a part is stored as soon as it is measured.
"""

import argparse
import json
import os
import tempfile
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.documents import DOCS, RESULTS_DIR, Row, commit, write_json
from benchmarks.gpu.document import PARTS, page
from benchmarks.gpu.kernels import kernel_rows
from benchmarks.gpu.paper import step_rows, training_rows
from benchmarks.gpu.plan import Plan, full_plan, smoke_plan
from benchmarks.gpu.tests import test_rows
from nvsf_core.drives.catalogue import catalogue_from_environment, home_from_environment
from nvsf_core.stages.runner.host import machine

_MEASURE = {"tests": test_rows, "kernels": kernel_rows, "steps": step_rows, "training": training_rows}


def main() -> None:
    """Measure and write, or say why not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="*", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--scenes", nargs="*", default=["street", "k360_street"])
    parser.add_argument("--minutes", type=float, default=10.0, help="of training `paper` on each scene")
    parser.add_argument("--smoke", action="store_true", help="tiny, on any machine")
    parser.add_argument("--to", type=Path, help="folder of gpu.json and gpu.md, default: the checkout's")
    arguments = parser.parse_args()
    results, document = RESULTS_DIR / "gpu.json", DOCS / "gpu.md"
    if arguments.to or arguments.smoke:
        folder = arguments.to or Path(tempfile.mkdtemp(prefix="gpu_smoke_"))
        results, document = folder / "gpu.json", folder / "gpu.md"
    if arguments.smoke:
        measure(smoke_plan(folder), arguments.parts, results, document)
    elif torch.cuda.is_available():
        known = {entry.name: entry for entry in catalogue_from_environment(os.environ)}
        scenes = tuple(known[name] for name in arguments.scenes if name in known)
        plan = full_plan(home_from_environment(os.environ), scenes, arguments.minutes)
        measure(plan, arguments.parts, results, document)
    else:
        parts = "; ".join(PARTS[part] for part in arguments.parts)
        print(f"No CUDA device is visible to torch {torch.__version__}. With one, this measures: {parts}.")
        write_page(results, document)
    print(f"{document} is written from {results}")


def measure(plan: Plan, parts: list[str], results: Path, document: Path) -> None:
    """Store each row when it is measured, and the page of all that is stored: a lent GPU may go any time."""
    for part in parts:
        rows = dict[str, list[Row]]()
        for row in _MEASURE[part](plan):
            # Scenes may be measured on different days, on different machines.
            scene = str(row.get("scene", ""))
            rows.setdefault(scene, []).append(row)
            about = {
                "machine": machine(), "triton": _triton(), "commit": commit(),
                "measured": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", "rows": rows[scene],
            }  # fmt: skip
            known = _stored(results)
            known[part] = known.get(part, {}) | {scene: about}
            write_json(results, known)
            write_page(results, document)


def write_page(results: Path, document: Path) -> None:
    """The page, from what is stored."""
    document.write_text(page(_stored(results)))


def _stored(results: Path) -> dict[str, Any]:
    return json.loads(results.read_text()) if results.is_file() else {}


def _triton() -> str:
    try:
        return version("triton")
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    main()
