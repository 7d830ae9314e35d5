"""Damage a tiny drive, home, catalogue or run at random, thousands of times, and count how each case ends.

``python -m benchmarks.hostile`` takes CASES (default 3000), SEED (0), ONLY (drive, home, catalogue, choice;
default all), uses every core, writes benchmarks/results/hostile.json and the tables of docs/safety.md, and
exits with 1 where a case ended in a library's error, a hang or a crash. A case is found again by its number.
"""

import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.common.documents import DOCS, RESULTS_DIR, Row, commit, write_between, write_measured
from benchmarks.hostile.limits import GIGABYTES, SECONDS, run_limited
from benchmarks.hostile.subjects import Templates
from benchmarks.hostile.table import FAULTS, counts, silent
from nvsf_core.stages.runner.host import machine

_SHARES = {"drive": 0.45, "home": 0.2, "catalogue": 0.2, "choice": 0.15}
_SAY_EVERY = 100


def main() -> int:
    """Harm, count, write."""
    asked, seed = int(os.environ.get("CASES") or 3000), int(os.environ.get("SEED") or 0)
    only = os.environ.get("ONLY", "").split() or list(_SHARES)
    whole = sum(_SHARES[name] for name in only)
    numbers = [(name, k) for name in only for k in range(round(asked * _SHARES[name] / whole))]
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        templates = Templates(Path(folder))
        rows = list(_run(templates, numbers, seed, Path(folder)))
    rows.sort(key=lambda row: (row["subject"], row["number"]))
    minutes = (time.monotonic() - started) / 60
    print(counts(rows), silent(rows), sep="\n")
    faults = [row for row in rows if row["kind"] in FAULTS]
    for row in faults:
        print("{subject} {number}: {harmed}: {how}: {kind}: {words}".format(**row))
    if only == list(_SHARES):
        _write(seed, minutes, rows)
    return 1 if faults else 0


def _run(templates: Templates, numbers: list[tuple[str, int]], seed: int, folder: Path) -> Iterator[Row]:
    tasks = [(templates, subject, number, seed, folder) for subject, number in numbers]
    with multiprocessing.get_context("fork").Pool(os.cpu_count()) as pool:
        for done, row in enumerate(pool.imap_unordered(_case, tasks), start=1):
            if row["kind"] in FAULTS:
                print(f"{row['subject']} {row['number']}: {row['kind']}: {row['words']}", file=sys.stderr)
            if done % _SAY_EVERY == 0:
                print(f"{done} of {len(tasks)} cases", file=sys.stderr)
            yield row


def _case(task: tuple[Templates, str, int, int, Path]) -> Row:
    templates, subject, number, seed, folder = task
    random = np.random.default_rng([seed, list(_SHARES).index(subject), number])
    place = Path(tempfile.mkdtemp(dir=folder))
    try:
        case = getattr(templates, subject)(place, random)
        end = run_limited(case.end)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return {
        "subject": subject, "number": number, "harmed": case.harmed, "how": case.how, "kind": end.kind,
        "words": end.words,
    }  # fmt: skip


def _write(seed: int, minutes: float, rows: list[Row]) -> None:
    told = [row for row in rows if row["kind"] in (*FAULTS, "silent")]
    facts = {
        "seed": seed, "minutes": minutes, "cases": len(rows),
        "limits": {"seconds": SECONDS, "gigabytes": GIGABYTES},
        "told": [{key: row[key] for key in ("subject", "harmed", "how", "kind")} for row in told],
    }  # fmt: skip
    write_measured(RESULTS_DIR / "hostile.json", facts)
    head = (
        f"{machine()}; commit {commit()}; seed {seed}; each case "
        f"has {SECONDS:.0f} s and {GIGABYTES:g} GB; {minutes:.0f} minutes.\n\n"
    )
    write_between(DOCS / "safety.md", "cases", head + counts(rows))
    write_between(DOCS / "safety.md", "silent", silent(rows))


if __name__ == "__main__":
    sys.exit(main())
