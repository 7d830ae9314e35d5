"""Tables of how many cases ended in which way, for docs/safety.md."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.common.documents import markdown_table

FAULTS = ("raw error", "hang", "crash")
_MOST_SILENT = 25
_MEANING = {
    "refused": "an error of the project's own tree",
    "doubted": "a check fails, or something is left out with its reason",
    "healed": "made again",
    "harmless": "the results are the same",
    "silent": "other results, and nothing says so",
    "raw error": "a library's error",
    "hang": "longer than its limit",
    "crash": "the process died",
}


def counts(rows: Sequence[Mapping[str, Any]]) -> str:
    """What was harmed against how it ended."""
    lines = []
    for subject in (*sorted({row["subject"] for row in rows}), "all"):
        found = Counter(row["kind"] for row in rows if subject in (row["subject"], "all"))
        lines.append(
            [subject, *(f"{count:,}" for count in (found.total(), *(found[kind] for kind in _MEANING)))]
        )
    table = markdown_table(["harmed", "cases", *_MEANING], lines, "| --- |" + " ---: |" * (len(_MEANING) + 1))
    words = "".join(f"- *{kind}*: {meaning}\n" for kind, meaning in _MEANING.items())
    return f"{table}\n{words}"


def silent(rows: Sequence[Mapping[str, Any]]) -> str:
    """What was accepted silently, by what was harmed and how."""
    found = Counter((row["harmed"], row["how"]) for row in rows if row["kind"] == "silent")
    if not found:
        return "Nothing was accepted silently.\n"
    lines: list[list[object]] = [
        [harmed, how, count] for (harmed, how), count in found.most_common(_MOST_SILENT)
    ]
    if len(found) > _MOST_SILENT:
        lines.append(["others", f"{len(found) - _MOST_SILENT} combinations of these", ""])
    return markdown_table(["harmed", "how", "cases"], lines, "| --- | --- | ---: |")
