"""The report's section on the checks of a scene's outputs: value, limit and verdict."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from nvsf_core.reporting.html import escape, number, plain_table
from nvsf_core.reporting.scene_outputs import SceneOutputs
from nvsf_core.reporting.stage_record import StageRecord

_NOT_RUN = "not run"
_HEAD = ("stage", "check", "value", "at most", "verdict")
_WORDS = (1, 4)


def checks_section(scene: SceneOutputs) -> str:
    """HTML of the checks: failed ones first, then those with a limit; empty if there are none.

    The checks of the newest run are visible, those of older runs are folded.
    """
    newest = f" {scene.runs[0].recipe} {scene.runs[0].seed}" if scene.runs else ""
    shown = [record for record in scene.records if " " not in record.stage or record.stage.endswith(newest)]
    judged = [(record, check) for record in shown for check in _shown(record)]
    if not judged:
        return ""
    doubts = sum(not check["passed"] for _, check in judged)
    older = [record for record in scene.records if record not in shown]
    folded = [(record, check) for record in older for check in _shown(record)]
    parts = [
        "<h3>Can these numbers be trusted?</h3>",
        f'<div class="note {"" if doubts else "good"}">{_in_words(doubts, len(judged))}</div>',
        _table([one for one in judged if not one[1]["passed"]]) if doubts else "",
        '<p class="soft">A check with a number compares it with the most that it may be. Limits of hit rates,'
        " intensities and greys come from the training scans and images of this drive, never from held-out"
        " ones. What breaks a check that makes an output unusable (NaN, out of limits, empty) is not"
        " published at all.</p>",
    ]
    held = [one for one in judged if one[1]["passed"]]
    if held:
        parts.append(f"<details><summary>{len(held)} checks that hold</summary>{_table(held)}</details>")
    if folded:
        parts.append(f"<details><summary>Checks of the older runs</summary>{_table(folded)}</details>")
    return "".join(parts)


def _shown(record: StageRecord) -> list[Mapping[str, Any]]:
    """The checks that failed, that have a limit, or that were not run."""
    return [
        check
        for check in record.checks
        if not check["passed"] or check.get("limit") is not None or str(check["detail"]).startswith(_NOT_RUN)
    ]


def _in_words(doubts: int, count: int) -> str:
    if doubts == 0:
        return f"Every check holds, {count} of {count}."
    return f"<b>{doubts} of {count} checks raise a doubt</b>; the reason stands in the last column."


def _table(judged: Iterable[tuple[StageRecord, Mapping[str, Any]]]) -> str:
    ordered = sorted(judged, key=lambda one: bool(one[1]["passed"]))
    return plain_table(_HEAD, [_row(record, check) for record, check in ordered], words=_WORDS)


def _row(record: StageRecord, check: Mapping[str, Any]) -> Sequence[str]:
    unit = f" {escape(check['unit'])}" if check.get("unit") else ""
    cells = [
        "–" if check.get(key) is None else f"{number(float(check[key]), _digits(check))}{unit}"
        for key in ("value", "limit")
    ]
    name = escape(str(check["name"]).replace("_", " "))
    detail = str(check["detail"])
    if detail.startswith(_NOT_RUN):
        verdict = f'<span class="soft">{escape(detail)}</span>'
    elif check["passed"]:
        verdict = f'holds <span class="soft">({escape(detail)})</span>'
    else:
        verdict = f'<b class="doubt">doubt:</b> {escape(detail)}'
    return [escape(record.stage), name, *cells, verdict]


def _digits(check: Mapping[str, Any]) -> int:
    """Decimal digits: none for counts, three for shares and lengths."""
    numbers = [check[key] for key in ("value", "limit") if check.get(key) is not None]
    return 0 if all(float(one).is_integer() for one in numbers) else 3
