"""Counts of how cases ended, as tables of a document."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

KINDS = ("refused", "doubted", "healed", "harmless", "silent", "raw error", "hang", "crash")
FAULTS = ("raw error", "hang", "crash")
_MEANING = {
    "refused": "an error of the project's own tree",
    "doubted": "a check fails, or something is left out with its reason",
    "healed": "made again",
    "harmless": "the results are the same",
    "silent": "other results, and nobody is told",
    "raw error": "a library's error",
    "hang": "longer than its limit",
    "crash": "the process died",
}


def counts(rows: Sequence[Mapping[str, Any]]) -> str:
    """What was harmed against how it ended."""
    subjects = sorted({row["subject"] for row in rows})
    lines = [f"| harmed | cases | {' | '.join(KINDS)} |", f"| --- |{' ---: |' * (len(KINDS) + 1)}"]
    for subject in subjects:
        found = Counter(row["kind"] for row in rows if row["subject"] == subject)
        cells = " | ".join(f"{found[kind]:,}" for kind in KINDS)
        lines.append(f"| {subject} | {sum(found.values()):,} | {cells} |")
    total = Counter(row["kind"] for row in rows)
    lines.append(f"| all | {len(rows):,} | {' | '.join(f'{total[kind]:,}' for kind in KINDS)} |")
    words = "; ".join(f"{kind}: {meaning}" for kind, meaning in _MEANING.items())
    return "\n".join([*lines, "", f"{words[0].upper()}{words[1:]}.", ""])


def silent(rows: Sequence[Mapping[str, Any]], most: int = 25) -> str:
    """What was accepted silently, by what was harmed and how."""
    found = Counter((row["harmed"], row["how"]) for row in rows if row["kind"] == "silent")
    if not found:
        return "Nothing was accepted silently.\n"
    lines = ["| harmed | how | cases |", "| --- | --- | ---: |"]
    lines += [f"| {harmed} | {how} | {count} |" for (harmed, how), count in found.most_common(most)]
    rest = len(found) - most
    return "\n".join([*lines, *([f"| others | {rest} combinations of these | |"] if rest > 0 else []), ""])
