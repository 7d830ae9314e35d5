"""Pieces of a self-contained HTML page: no script, no external link."""

import base64
import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from nvsf_core.metrics.table import over_most_frames

_STYLE = """
:root { --ink:#1c2430; --soft:#5b6675; --line:#dfe4ea; --back:#f6f7f9; --best:#e3f4e8; --best-ink:#0f6b32;
  --accent:#1f6feb; --warn:#fff3df; --warn-ink:#8a5300; --bad:#fdeaea; --bad-ink:#9b1c1c; }
* { box-sizing:border-box; }
body { margin:0; background:var(--back); color:var(--ink);
  font:15px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif; }
main { max-width:1180px; margin:0 auto; padding:28px 24px 80px; }
h1 { font-size:28px; margin:0 0 4px; } h2 { font-size:22px; margin:0 0 4px; }
h3 { font-size:16px; margin:28px 0 6px; }
p { margin:6px 0 10px; max-width:860px; } .soft, figcaption { color:var(--soft); }
section { background:#fff; border:1px solid var(--line); border-radius:10px; padding:22px 24px;
  margin:22px 0; }
nav { position:sticky; top:0; z-index:1; background:var(--back); padding:6px 0; }
nav a { margin-right:14px; }
a { color:var(--accent); text-decoration:none; } a:hover { text-decoration:underline; }
code { background:#eef1f5; border-radius:4px; padding:1px 5px; font-size:.92em; }
.scroll { overflow-x:auto; }
table { border-collapse:collapse; margin:8px 0 4px; font-size:14px; font-variant-numeric:tabular-nums; }
th, td { padding:5px 8px; text-align:right; border-bottom:1px solid var(--line); }
td { white-space:nowrap; }
th:first-child, td:first-child { text-align:left; }
td.words, th.words { text-align:left; white-space:normal; }
thead th { font-weight:600; color:var(--soft); vertical-align:bottom; font-size:13px; line-height:1.3; }
thead tr.groups th { color:var(--ink); text-align:center; border-bottom:2px solid var(--line); }
thead tr.groups th + th, .edge { border-left:1px solid var(--line); }
td.best { background:var(--best); color:var(--best-ink); font-weight:650; }
tr.model td:first-child { font-weight:650; color:var(--accent); }
figure { margin:14px 0; } figcaption { font-size:13.5px; margin:4px 0 0; max-width:860px; }
img { max-width:100%; display:block; border-radius:4px; } img.wide { width:100%; image-rendering:auto; }
.label { font-size:13px; font-weight:600; margin:10px 0 3px; }
.row { display:grid; gap:14px; } .row img { width:100%; }
.row.above { grid-template-columns:repeat(4,minmax(0,1fr)); }
.row.camera { grid-template-columns:repeat(2,minmax(0,1fr)); }
.scale { position:relative; width:300px; margin:8px 56px 24px 14px; display:inline-block;
  vertical-align:top; }
.scale img { width:300px; height:12px; border-radius:3px; }
.scale span { position:absolute; white-space:nowrap; top:13px; font-size:11.5px; color:var(--soft);
  transform:translateX(-50%); }
.key { display:inline-block; margin:4px 18px 0 0; font-size:13px; color:var(--soft); }
.key i { display:inline-block; width:12px; height:12px; border-radius:3px; margin-right:5px;
  vertical-align:-1px; }
.bar { display:inline-block; height:11px; background:var(--accent); opacity:.75; border-radius:3px; }
.note { border-radius:8px; padding:9px 14px; margin:10px 0; max-width:900px; background:var(--warn);
  color:var(--warn-ink); }
.note.bad { background:var(--bad); color:var(--bad-ink); } .note.good { background:var(--best);
  color:var(--best-ink); }
.note.word { display:inline-block; margin:0; padding:1px 8px; white-space:nowrap; }
.doubt { background:var(--warn); color:var(--warn-ink); border-radius:4px; padding:1px 6px; }
details { margin:14px 0 0; } summary { cursor:pointer; color:var(--accent); font-weight:600; }
pre { white-space:pre-wrap; overflow-wrap:anywhere; margin:4px 0; font-size:13px; }
"""

_UP = ("f_score", "psnr", "ssim", "accuracy")
UNITS = {"m2": "m²", "1": "", "m": "m", "dB": "dB"}
"""Stored units as they are printed, where they differ; empty for a bare number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column of a table of methods."""

    group: str
    """Heading above neighbouring columns of the same group."""
    title: str
    unit: str
    higher_is_better: bool | None
    """None = no value is marked as best."""
    values: list[float]
    """One per method; NaN = undefined."""
    notes: list[str]
    """Tooltip of each value, for example how many frames are undefined; empty = none."""
    digits: int
    n_defined: Sequence[int] = ()
    """Frames that each mean is over; empty = of all the same."""


def escape(value: Any) -> str:
    """Any value as text with HTML's special characters escaped."""
    return html.escape(str(value))


def page(title: str, body: str) -> str:
    """The whole HTML document around a ready-made body."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        "</body>\n</html>\n"
    )


def image(picture: bytes, alt: str, css: str = "", kind: str = "png") -> str:
    """An image tag with the PNG (or another `kind`) embedded; `css` is its class."""
    data = base64.b64encode(picture).decode()
    return f'<img class="{css}" alt="{escape(alt)}" src="data:image/{kind};base64,{data}">'


def plot(png: bytes, alt: str) -> str:
    """An image tag of a plot of 144 dots per inch, shown at its natural size."""
    width = round(int.from_bytes(png[16:20], "big") * 96 / 144)
    return image(png, alt).replace("<img ", f'<img style="width:{width}px" ', 1)


def figure(parts: Sequence[str], caption: str) -> str:
    """Ready-made parts (HTML) with a caption (text) below them."""
    return f"<figure>{''.join(parts)}<figcaption>{escape(caption)}</figcaption></figure>"


def methods_table(methods: Sequence[tuple[str, str, bool]], columns: Sequence[Column]) -> str:
    """HTML table with one row per method; the best value of a column is marked, ties too.

    Methods have a name, a description, and whether they are trained; columns of a group stand together.
    """
    groups: list[list[Any]] = []
    for column in columns:
        if groups and groups[-1][0] == column.group:
            groups[-1][1] += 1
        else:
            groups.append([column.group, 1])
    starts = {sum(count for _, count in groups[:i]) for i in range(len(groups))}
    head = "".join(f'<th colspan="{count}">{escape(name)}</th>' for name, count in groups)
    titles = "".join(
        f'<th class="{"edge" if i in starts else ""}">{_title(column)}</th>'
        for i, column in enumerate(columns)
    )
    rows = []
    for row, (name, what, learned) in enumerate(methods):
        cells = "".join(_cell(column, row, i in starts) for i, column in enumerate(columns))
        rows.append(
            f'<tr class="{"model" if learned else "baseline"}"><td'
            f' title="{escape(what)}">{escape(name)}</td>{cells}</tr>'
        )
    return (
        '<div class="scroll"><table><thead><tr'
        f' class="groups"><th></th>{head}</tr><tr><th>method</th>{titles}</tr>'
        f"</thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def plain_table(head: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[int] = ()) -> str:
    """HTML table of ready-made cells (HTML); columns whose index is in `words` wrap as text."""

    def css(i: int) -> str:
        return ' class="words"' if i in words else ""

    top = "".join(f"<th{css(i)}>{escape(cell)}</th>" for i, cell in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f"<td{css(i)}>{cell}</td>" for i, cell in enumerate(row)) + "</tr>" for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def number(value: float, digits: int) -> str:
    """A number for a table: a dash for NaN, groups of three digits from 10 000 on."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:,.{digits}f}".replace(",", " ") if abs(value) >= 10_000 else f"{value:.{digits}f}"


def best_rows(column: Column) -> set[int]:
    """Rows whose shown value is the column's best; empty if fewer than two values are finite.

    A mean over fewer frames than another is never the best.
    """
    finite = {row: value for row, value in enumerate(column.values) if math.isfinite(value)}
    if column.higher_is_better is None or len(finite) < 2:
        return set()
    known = [row for row, value in enumerate(column.values) if not math.isnan(value)]
    whole = over_most_frames({row: column.n_defined[row] if column.n_defined else 0 for row in known})
    values = {row: value for row, value in finite.items() if row in whole}
    best = (max if column.higher_is_better else min)(values.values(), default=0.0)
    shown = number(best, column.digits)
    return {row for row, value in values.items() if number(value, column.digits) == shown}


def higher_is_better(metric: str) -> bool:
    """Whether larger values of a metric are better, by its name."""
    return any(word in metric for word in _UP)


def _title(column: Column) -> str:
    arrow = {True: " ↑", False: " ↓", None: ""}[column.higher_is_better]
    unit = f" [{escape(column.unit)}]" if column.unit else ""
    return f"{escape(column.title)}<br>{unit}{arrow}" if unit or arrow else escape(column.title)


def _cell(column: Column, row: int, edge: bool) -> str:
    css = " ".join(name for name, on in (("best", row in best_rows(column)), ("edge", edge)) if on)
    note = column.notes[row]
    mark = "*" if note else ""
    return f'<td class="{css}" title="{escape(note)}">{number(column.values[row], column.digits)}{mark}</td>'
