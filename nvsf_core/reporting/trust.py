"""The report's section "Can this view be trusted?": verdicts without truth, and errors by support beside."""

import math
from collections.abc import Mapping, Sequence

from nvsf_core.metrics.support_pool import Pooled, pool_by_support
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.metrics.trust.cues import GUESSED_SHARE, IMAGE_CUES, SCAN_CUES, Cue
from nvsf_core.metrics.trust.verdict import (
    EASILY_DISTINGUISHED,
    LIDAR,
    LITTLE_GUESSED,
    LITTLE_MISSING,
    MUCH_GUESSED,
    MUCH_MISSING,
    NOTICED,
    STRANGE,
    TOO_FAR,
    Trust,
    Verdict,
    verdicts,
)
from nvsf_core.rendering.rendered import Support
from nvsf_core.reporting.html import escape, number, plain_table
from nvsf_core.reporting.scene_outputs import FieldRun
from nvsf_core.reporting.tables import Row

_BY_SUPPORT = (
    ("raw", "f_score", "points within 22 cm of the truth (F-score) ↑", 3),
    ("raw", "hit_accuracy", "rays rightly returning or not ↑", 3),
    ("image", "image_psnr_db", "likeness of pixels (PSNR [dB]) ↑", 1),
)
"""Protocol, metric, words and digits of the rows of the table of errors by support."""
_LEAST_SHARE = 0.001
"""Of fewer rays, points or pixels no error is shown: a handful says nothing of a mark."""
_SUPPORT_WORDS = {
    Support.SEEN: "seen: recorded from about there",
    Support.EXTRAPOLATED: "extrapolated: recorded from elsewhere",
    Support.GUESSED: "guessed: never recorded",
}
_CSS = {Trust.AS_RECORDED: "good", Trust.WITH_CARE: "", Trust.DO_NOT_USE: "bad", Trust.NOT_KNOWN: ""}


def trust_section(run: FieldRun) -> str:
    """HTML of the verdicts on a run's views, and of errors by support; empty without a verdict."""
    said = verdicts(run.means)
    if not said:
        return ""
    views = sorted(dict.fromkeys(one.view for one in said), key=lambda view: view != HELD_OUT)
    lines = [_line(view, [one for one in said if one.view == view]) for view in views]
    return "".join(
        [
            "<h3>Can this view be trusted?</h3>",
            "<p>Nobody recorded what a new view should show, so its error cannot be measured. But a view can"
            " be compared with the recording: is there a recorded surface where its points lie? Do its"
            " pictures match the recorded ones when they are carried back into them? How much of it did"
            " nobody ever look at? Recorded scans and pictures differ among themselves, too; a view that"
            " differs no more than these is called <b>as recorded</b>.</p>",
            plain_table(("view", "scans", "pictures", "why"), lines, words=(1, 2, 3)),
            _figures(said),
            _by_support(run.by_support),
        ]
    )


def _line(view: str, said: Sequence[Verdict]) -> list[str]:
    """One line on a view: the worst verdict on scans and on pictures, and the reason of each that doubts."""
    scans = [one for one in said if one.sensor == LIDAR]
    others = [one for one in said if one not in scans]
    worst = {
        of: max(mine, key=_badness) for of, mine in (("Scans", scans), ("Pictures", others)) if mine
    }  # fmt: skip
    doubted = {of: one for of, one in worst.items() if one.trust is not Trust.AS_RECORDED}
    if len(said) == 1 or (len(worst) == 1 and not doubted):
        why = next(iter(worst.values())).why
    elif not doubted:
        why = "Scans and pictures fit the recorded ones as well as these fit each other."
    else:
        why = " ".join(f"{of}: {one.why[0].lower()}{one.why[1:]}" for of, one in doubted.items())
    return [_name(view), _words(scans), _words(others), escape(why)]


def _name(view: str) -> str:
    return "held-out frames" if view == HELD_OUT else f"<code>{escape(view)}</code>"


def _words(said: Sequence[Verdict]) -> str:
    if not said:
        return "–"
    worst = max(said, key=_badness)
    return f'<span class="note {_CSS[worst.trust]} word">{worst.trust.words}</span>'


def _badness(one: Verdict) -> tuple[int, float]:
    return one.trust, one.ratio if math.isfinite(one.ratio) else math.inf


def _figures(said: Sequence[Verdict]) -> str:
    """The cues of every view in a fold, with the band of recorded data, scans and pictures by themselves."""
    parts = []
    for title, is_lidar, cues in (("Scans", True, SCAN_CUES), ("Pictures", False, IMAGE_CUES)):
        mine = [one for one in said if (one.sensor == LIDAR) == is_lidar]
        if mine:
            parts.append(f'<div class="label">{title}</div>{_cue_table(mine, (*cues, GUESSED_SHARE))}')
    rule = (
        "The score is a plain mean of the first columns. <b>As recorded</b>: a score no larger than those of"
        f" recorded data and at most {NOTICED:g} times their median, at most {LITTLE_GUESSED:.0%} guessed,"
        f" at most {LITTLE_MISSING:.0%} of the returns missing, and no figure beyond {STRANGE:g}"
        " times the largest of recorded data, that of patches distinguished not beyond"
        f" {EASILY_DISTINGUISHED:g}. <b>Do not use</b>: more than {TOO_FAR:g} times that median,"
        f" more than {MUCH_GUESSED:.0%} guessed, or more than {MUCH_MISSING:.0%} missing. These limits were"
        " set by hand. In brackets: least to largest value that recorded scans or pictures, left out in turn,"
        " have against the others."
        " Guessed parts are marked as such in every data set and can be left out."
    )
    return f'<details><summary>The figures</summary>{"".join(parts)}<p class="soft">{rule}</p></details>'


def _cue_table(said: Sequence[Verdict], cues: Sequence[Cue]) -> str:
    titles = [cue.title if cue.unit == "1" else f"{cue.title} [{cue.unit}]" for cue in cues]
    head = ["view", "sensor", "score over the recorded", *titles]
    rows = [
        [_name(one.view), escape(one.sensor), number(one.ratio, 2), *(_value(one, cue) for cue in cues)]
        for one in said
    ]
    return plain_table(head, rows, words=(1,))


def _value(one: Verdict, cue: Cue) -> str:
    band = one.bands.get(cue.name)
    shown = number(one.values.get(cue.name, math.nan), 3)
    if band is None:
        return shown
    return f'{shown} <span class="soft">({number(band.low, 3)}–{number(band.high, 3)})</span>'


def _by_support(rows: Sequence[Row]) -> str:
    """Errors by support, pooled over the views whose truth is known, and view by view; empty without one."""
    lines, folded = [], []
    for protocol, metric, words, digits in _BY_SUPPORT:
        mine = [row for row in rows if (row["protocol"], row["metric"]) == (protocol, metric)]
        pooled = pool_by_support(mine, protocol, metric)
        if any(one.n_valid for one in pooled.values()):
            lines.append([words, *_with_shares(pooled, digits)])
        for view, sensor in dict.fromkeys((row["split"], row["sensor"]) for row in mine):
            own = [row for row in mine if (row["split"], row["sensor"]) == (view, sensor)]
            cells = _with_shares(pool_by_support(own, protocol, metric), digits)
            folded.append([f"{_name(view)}, {escape(sensor)}: {words}", *cells])
    if not lines:
        return ""
    head = ("error by support", *_SUPPORT_WORDS.values())
    note = (
        "Each point and pixel is marked by what the recording knows of it. The marks, too, are made without"
        " the truth; here it is known, so that they can be checked: errors should grow from left to right."
        " Each ray, point or pixel of all views, sensors and frames counts once. In brackets: their share;"
        f" below {_LEAST_SHARE:.1%} there are too few for an error."
    )
    return (
        f"<h4>Are the marks right?</h4><p>{note}</p>{plain_table(head, lines)}"
        f"<details><summary>The same, view by view</summary>{plain_table(head, folded)}</details>"
    )


def _with_shares(pooled: Mapping[Support, Pooled], digits: int) -> list[str]:
    """Cells of a metric by support, each with the share that it rests on."""
    total = max(1, sum(one.n_valid for one in pooled.values()))
    cells = []
    for support in _SUPPORT_WORDS:
        share = pooled[support].n_valid / total
        shown = number(pooled[support].value if share >= _LEAST_SHARE else math.nan, digits)
        cells.append(f'{shown} <span class="soft">({share:.1%})</span>')
    return cells
