"""The table of events and outcomes, `docs/chaos.md`."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.common import documents
from nvsf_core.stages.runner.host import machine

Row = Mapping[str, Any]
_LONGEST_HOW = 90


def write_document_of(rows: Sequence[Row], seed: int, minutes: float, *, keep: bool) -> None:
    """Store what happened, and write the tables of the document."""
    path = documents.RESULTS_DIR / "chaos.json"
    before = json.loads(path.read_text()) if keep and path.is_file() else {"rounds": [], "rows": []}
    this = {"commit": documents.commit(), "seed": seed, "minutes": minutes, "events": len(rows)}
    facts = {"rounds": [*before["rounds"], this], "rows": [*before["rows"], *map(dict, rows)]}
    documents.write_measured(path, facts)
    page = documents.DOCS / "chaos.md"
    documents.write_between(page, "events", head(facts["rounds"]) + counts(facts["rows"]))
    documents.write_between(page, "each", each(facts["rows"]))


def head(rounds: Sequence[Row]) -> str:
    """The machine, and of each round its commit, seed, minutes and events."""
    words = (
        f"commit {one['commit']}, seed {one['seed']}, {one['minutes']:.0f} minutes, {one['events']} events"
        for one in rounds
    )
    return f"{machine()}; {'; '.join(words)}.\n\n"


def counts(rows: Sequence[Row]) -> str:
    """Each kind of event, how often it came, and how often something was lost."""
    kinds = {row["event"]: row["what"] for row in rows}
    lines = list[list[object]]()
    for event, what in (*sorted(kinds.items(), key=lambda one: one[1]), ("", "all")):
        own = [row for row in rows if event in ("", row["event"])]
        lines.append([what, len(own), sum(bool(row["faults"]) for row in own)])
    return documents.markdown_table(["event", "times", "with a fault"], lines, "| --- | ---: | ---: |")


def each(rows: Sequence[Row]) -> str:
    """Every event in its order, what was done, and what came of it."""
    lines = [
        [number, row["event"], row["how"][:_LONGEST_HOW], f"{row['seconds']:.0f}", _outcome(row)]
        for number, row in enumerate(rows, start=1)
    ]
    titles = ["number", "event", "details", "seconds", "outcome"]
    return documents.markdown_table(titles, lines, "| ---: | --- | --- | ---: | --- |")


def _outcome(row: Row) -> str:
    return "; ".join(row["faults"])[:200].replace("|", "/").replace("\n", " ") or "nothing lost"
