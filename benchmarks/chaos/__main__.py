"""Harm a home at work for some minutes, and write what came of it.

``python -m benchmarks.chaos`` takes MINUTES (default 60), SEED (0), ONLY (names of events; default all), KEEP
(any text: what was stored before is shown with it) and SHORT (any text: the short form, of the library alone,
some events once; nothing is written, as with ONLY). It ends with 1 where something was lost, half-written or
held, where the next run did not go on, or where nothing was said.
"""

import os
import random
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.chaos.aftermath import Ledger, ledger_of, left_behind, losses, next_run
from benchmarks.chaos.document import Row, write_document_of
from benchmarks.chaos.event import Event, Random
from benchmarks.chaos.events import daemons, files, kills, limits
from benchmarks.chaos.instance import hanging
from benchmarks.chaos.world import LONGEST_RUN_S, World, made_world

EVENTS = [*kills.EVENTS, *files.EVENTS, *limits.EVENTS, *daemons.EVENTS]


def main() -> int:
    """Harm, look, write; of any argument, which none of this is asked by, only say how it is asked."""
    if sys.argv[1:]:
        print(__doc__)
        return 0 if sys.argv[1] in ("-h", "--help") else 2
    is_short = bool(os.environ.get("SHORT"))
    minutes, seed = float(os.environ.get("MINUTES") or 60.0), int(os.environ.get("SEED") or 0)
    only = os.environ.get("ONLY", "").split()
    chance, started_s = random.Random(seed), time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="nvsf-chaos-") as folder,
        made_world(Path(folder), bare=is_short) as world,
    ):
        events = [event for event in _possible(world) if not only or event.name in only]
        chosen = iter(events) if is_short else _chosen(events, chance, started_s + 60 * minutes)
        rows = list(_rows(world, chosen, chance))
    faults = [f"{row['event']}: {row['how']}: {fault}" for row in rows for fault in row["faults"]]
    print(f"{len(rows)} events, {len(faults)} faults", *faults, sep="\n")
    if not is_short and not only:
        keep = bool(os.environ.get("KEEP"))
        write_document_of(rows, seed, (time.monotonic() - started_s) / 60, keep=keep)
    return 1 if faults else 0


def _possible(world: World) -> list[Event]:
    return [
        event
        for event in EVENTS
        if (world.has_disk or not event.needs_disk) and not (world.bare and event.needs_dagster)
    ]


def _chosen(events: list[Event], chance: Random, until_s: float) -> Iterator[Event]:
    """Every event once, in a random order, then by their weights, until the time is up."""
    first = chance.sample(events, len(events))
    while time.monotonic() < until_s:
        yield first.pop() if first else chance.choices(events, [event.weight for event in events])[0]


def _rows(world: World, events: Iterator[Event], chance: Random) -> Iterator[Row]:
    code = world.start().wait(LONGEST_RUN_S)
    if code != 0:
        raise SystemExit(f"the first run, undisturbed, ended with {code}: see {world.folder}")
    for event in events:
        started_s, before = time.monotonic(), ledger_of(world)
        harm = event.harm(world, chance)
        faults = []
        if harm.expected and not re.search(harm.expected, harm.said):
            faults.append(f"expected the words {harm.expected!r}, found {harm.said[-800:]!r}")
        faults += _after(world, before)
        seconds = time.monotonic() - started_s
        outcome = "; ".join(faults) or "nothing lost"
        print(f"{seconds:5.0f} s  {event.name}: {harm.how}: {outcome}", flush=True)
        yield {
            "event": event.name, "what": event.what, "how": harm.how, "seconds": seconds, "faults": faults
        }  # fmt: skip


def _after(world: World, before: Ledger) -> Iterator[str]:
    yield from next_run(world)
    yield from losses(world, before)
    yield from left_behind(world)
    if not world.bare:
        yield from hanging(world)


if __name__ == "__main__":
    sys.exit(main())
