"""The report over all scenes: one offline HTML page for readers who do not know this project."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from nvsf_core.metrics.headline import LEAST_LEVEL
from nvsf_core.metrics.table import BASELINES
from nvsf_core.reporting import plots
from nvsf_core.reporting.checks import checks_section
from nvsf_core.reporting.error_cloud import error_cloud_figure
from nvsf_core.reporting.html import escape, figure, methods_table, number, page, plain_table, plot
from nvsf_core.reporting.scene_notes import evidence_table, holds_paper_scene, not_run
from nvsf_core.reporting.scene_outputs import FieldRun, SceneOutputs, mean_of, method_rows
from nvsf_core.reporting.tables import (
    METHOD_WORDS,
    PROTOCOLS,
    Row,
    full_tables,
    headline_columns,
    level_with,
    methods_of,
    over_seeds,
    wins,
)
from nvsf_core.reporting.trust import trust_section
from nvsf_core.reporting.view_pictures import view_section

_COSTS = (
    ("lidar4d_scan", "chamfer_m2", "LiDAR: Chamfer [m²], lower is better"),
    ("raw", "range_abs_error_median_m", "LiDAR: median range error [m], lower is better"),
    ("image", "image_psnr_db", "Camera: PSNR [dB], higher is better"),
)  # fmt: skip


def report_html(sections: Sequence[tuple[SceneOutputs, str]], no_data: Sequence[str], more: str = "") -> str:
    """The page, as text: scenes in the given order, then the ready-made sections `more` (HTML).

    `sections` are scenes as `scene_section` gives them; pictures are not asked for again. `no_data` are
    catalogue scenes whose recordings are not on this machine.
    """
    scenes = [scene for scene, _ in sections]
    measured = [scene for scene in scenes if scene.runs]
    parts = [
        _title(scenes),
        *(f"<b>{escape(scene.name)}</b>{_verdict(method_rows(scene))}" for scene in measured),
        _intro(),
        _summary(scenes, measured, no_data),
        _how_to_read(),
    ]
    parts += [*(section for _, section in sections), more]
    return page("NVSF benchmark report", "\n".join(parts))


def scene_section(scene: SceneOutputs) -> tuple[SceneOutputs, str]:
    """The scene and its section (HTML); if its numbers cannot be shown, a scene with only the reason."""
    try:
        section = _scene(scene)
        if scene.runs:
            _summary([scene], [scene], [])
    except Exception as error:  # plots and formats fail on numbers that no stage writes
        reasons = [scene.failure, f"what was published cannot be shown: {error!r:.200}"]
        scene = SceneOutputs(name=scene.name, failure="; ".join(filter(None, reasons)))
        section = _scene(scene)
    return scene, section


def write_report(
    folder: Path, sections: Sequence[tuple[SceneOutputs, str]], no_data: Sequence[str], more: str = ""
) -> Path:
    """Write `index.html` into a folder; returns its path. Arguments as of `report_html`."""
    path = folder / "index.html"
    path.write_text(report_html(sections, no_data, more), encoding="utf-8", errors="backslashreplace")
    return path


def _title(scenes: Sequence[SceneOutputs]) -> str:
    links = [("all-scenes", "All scenes"), ("how-to-read", "How to read this")]
    links += [(scene.name, scene.name) for scene in scenes]
    shown = "".join(f'<a href="#{escape(place)}">{escape(words)}</a>' for place, words in links)
    shown += '<a href="versions.html">Versions of the data sets</a>'
    return f"<h1>Benchmark report</h1><nav>{shown}</nav>"


def _intro() -> str:
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return (
        "<p>A car with a spinning laser scanner (LiDAR) and cameras drove through a street. From that"
        " recording a model of the scene was trained, and from the model new scans and pictures were"
        " rendered. Some recorded instants were <b>held out</b>: the model never saw them. This page"
        " compares what the model renders there with what was really recorded, beside simple methods that"
        " learn nothing, and says what each took in time.</p>"
        f'<p class="soft">Made {made}. This page is one file and needs no network; pages of scans in three'
        " dimensions lie beside it, in <code>views</code>.</p>"
    )


def _summary(scenes: Sequence[SceneOutputs], measured: Sequence[SceneOutputs], no_data: Sequence[str]) -> str:
    parts = ['<section id="all-scenes"><h2>All scenes</h2>']
    head = ["scene", "method", "seed", "Chamfer [m²] ↓", "F-score ↑", "range PSNR [dB] ↑",
            "image PSNR [dB] ↑", "training [s]", "best in", "commit", "measured"]  # fmt: skip
    lines = []
    for scene in measured:
        rows = method_rows(scene)
        best = wins(rows)
        for position, (name, _, learned) in enumerate(methods_of(rows)):
            mine = [row for row in rows if row["method"] == name]
            cells = [
                number(mean_of(mine, protocol, metric)[0], digits)
                for protocol, metric, digits in (
                    ("lidar4d_scan", "chamfer_m2", 4), ("lidar4d_scan", "f_score", 3),
                    ("lidar4d_scan", "range_psnr_db", 2), ("image", "image_psnr_db", 2),
                )
            ]  # fmt: skip
            columns = sum(column.higher_is_better is not None for column in headline_columns(rows))
            train = number(float(mine[0]["train_seconds"] or 0.0), 1)
            recipe, run = escape(mine[0]["recipe"]), mine[0]["run"]
            shown, seed = (f"<b>{recipe}</b>", str(run.seed)) if learned else (recipe, "")
            link = f'<a href="#{escape(scene.name)}">{escape(scene.name)}</a>' if position == 0 else ""
            source = [_commit(run), f"{run.measured:%Y-%m-%d %H:%M}"]
            count = f"{best[mine[0]['recipe']]} of {columns}"
            lines.append([link, shown, seed, *cells, train, count, *source])
    if lines:
        parts.append(plain_table(head, lines, words=(0, 1)))
        parts.append(
            '<p class="soft">Means over the held-out frames; LiDAR by the protocol'
            " <code>lidar4d_scan</code>, images by <code>image</code>, mean over the cameras. “Best in”"
            " counts the main numbers of a scene in which a method is the best one; where a model and a"
            " baseline are level to the last digit, neither is. A recipe’s are means over its seeds, so that"
            " each of its rows has the same count.</p>"
            '<p class="soft">The page holds <b>everything that was measured in this folder</b>, not only the'
            " last run; runs at other held-out frames than a scene’s newest are only named in its section."
            " A trained model’s row is named by its recipe (what was trained, and how long) and"
            " seed (of its random numbers); commit: the version of the code that measured it; measured: when,"
            " UTC. A baseline has no seed; its row comes from the scene’s newest run. Rows of different"
            " commits may differ because the code does.</p>"
        )
    else:
        parts.append('<div class="note">No scene has been measured yet.</div>')
    failed = [scene for scene in scenes if scene.failure]
    for scene in failed:
        parts.append(
            f'<div class="note bad"><b>{escape(scene.name)}'
            f" failed:</b><pre>{escape(scene.failure)}</pre></div>"
        )
    if no_data:
        names = ", ".join(f"<code>{escape(name)}</code>" for name in no_data)
        parts.append(
            f'<div class="note"><b>No data on this machine</b> for these scenes of the catalogue:'
            f" {names}. They were not run, and nothing is claimed about them.</div>"
        )
    if not holds_paper_scene(scene.name for scene in measured):
        parts.append(
            '<p class="soft">Not measured on KITTI-360’s ten scenes that papers report on: their recordings'
            " were never at hand. Numbers published elsewhere are of other scenes, so none stand here beside"
            " ours.</p>"
        )
    return "".join([*parts, "</section>"])


def _commit(run: FieldRun) -> str:
    shown = f"<code>{escape(run.commit[:10])}</code>"
    return f'<span title="{escape(run.commit)}">{shown}</span>' if run.commit else "–"


def _provenance(scene: SceneOutputs) -> str:
    """The runs that the rows of the scene's tables come from."""
    runs = "; ".join(
        f"<b>{escape(run.recipe)}</b>, seed {run.seed}: commit {_commit(run)}, "
        f"{run.measured:%Y-%m-%d %H:%M} UTC" + (f", on {escape(run.machine)}" if run.machine else "")
        for run in scene.runs
        if run.is_comparable
    )
    newest = " Baselines and pictures are of the first of these." if len(scene.runs) > 1 else ""
    return f'<p class="soft">Measured: {runs}.{newest}{_left_out(scene)}</p>'


def _left_out(scene: SceneOutputs) -> str:
    """Which runs, and views of runs, are in no table, and why; empty if all are."""
    names = ", ".join(_named(run) for run in scene.runs if not run.is_comparable)
    of_views = ", ".join(
        f"<code>{escape(view)}</code> of {_named(run)}"
        for run in scene.runs
        if run.is_comparable
        for view in sorted(run.other_views)
    )
    parts = []
    if names:
        parts.append(
            f" Left out of the tables: {names}; measured at other held-out frames than the newest run, or"
            " against other recorded data, so that errors do not compare. Train it again to have it beside"
            " the others."
        )
    if of_views:
        parts.append(
            f" Views left out of the tables: {of_views}; the newest run’s view of that name is another one"
            " (other keys in the catalogue, other frames or other true images) or has no errors. Run the"
            " recipe again to have it beside the others."
        )
    return "".join(parts)


def _named(run: FieldRun) -> str:
    return f"<b>{escape(run.recipe)}</b>, seed {run.seed} ({run.measured:%Y-%m-%d})"


def _how_to_read() -> str:
    methods = "".join(f"<li><code>{name}</code>: {escape(METHOD_WORDS[name])}.</li>" for name in BASELINES)
    protocols = "".join(
        f"<li><code>{name}</code>: {escape(words)}.</li>" for name, words in PROTOCOLS.items()
    )
    return (
        '<section id="how-to-read"><h2>How to read this</h2>'
        "<h3>Methods</h3><ul><li>A name in <b>blue</b>, such as"
        " <code>quick</code>: the trained model, called by its recipe.</li>"
        f"{methods}</ul><p>A model earns its training time only where it beats them all.</p>"
        "<details><summary>Measures and protocols</summary><ul>"
        "<li><b>Chamfer</b>: mean squared distance from each point of one cloud to the nearest of the other,"
        " both ways added; small is good. <b>F-score</b>: how much of both clouds lies within 22 cm (d²"
        " below 0.05 m²) of the other; 1 is perfect.</li>"
        "<li><b>Range error</b>: distance between predicted and recorded return along the very rays that the"
        " recording returned on. A ray without an answer counts as infinitely wrong; <b>no answer</b> is"
        " their share.</li>"
        "<li><b>Hit accuracy</b>: share of the laser’s directions for which it is rightly predicted whether"
        " anything comes"
        " back. The unknown phase of the scanner’s turn keeps a real sensor from exceeding about 0.99.</li>"
        "<li><b>PSNR, SSIM</b>: likeness of pictures; large is good.</li></ul><p>A protocol says what"
        f" exactly is compared:</p><ul>{protocols}</ul></details>"
        "<p>In tables, ↓ means that lower is better, ↑ that higher is; the best value of a column has a"
        " <span style='background:var(--best);color:var(--best-ink);padding:1px 6px'>green ground</span>."
        " “–” is undefined, never zero; * is undefined on some frames (point at it), and never the best"
        " beside a value of more frames.</p></section>"
    )


def _scene(scene: SceneOutputs) -> str:
    parts = [f'<section id="{escape(scene.name)}"><h2>{escape(scene.name)}</h2>']
    if scene.failure:
        parts.append(f'<div class="note bad"><b>Failed:</b><pre>{escape(scene.failure)}</pre></div>')
    if not scene.runs:
        parts.append("<p>Nothing has been measured for this scene.</p>")
        return "".join([*parts, _stages(scene), "</section>"])
    rows = method_rows(scene)
    newest = scene.runs[0]
    parts += [
        _verdict(rows),
        _data_sets(scene),
        "<h3>Error beside time</h3>",
        methods_table(methods_of(rows), headline_columns(rows)),
        not_run(scene),
        _provenance(scene),
        _cost_plot(rows),
        checks_section(scene),
        trust_section(newest),
    ]
    for view in newest.pictures:
        parts.append(view_section(view, newest.recipe, rows))
    parts.append(error_cloud_figure(newest.error_cloud))
    curves = [run for run in scene.runs if run.curve.get("step")]
    if curves:
        parts.append("<h3>Training</h3>")
        parts.append(_loss_curve(curves[0]))
    if curves[1:]:
        older = "".join(_loss_curve(run) for run in curves[1:])
        parts.append(f"<details><summary>Loss of the older runs</summary>{older}</details>")
    parts.append(evidence_table(scene))
    parts.append(_stages(scene))
    tables = "".join(f'<div class="label">{escape(name)}</div>{table}' for name, table in full_tables(rows))
    parts.append(
        f"<details><summary>All metrics, by protocol and sensor</summary>{tables}</details></section>"
    )
    return "".join(parts)


def _verdict(rows: Sequence[Row]) -> str:
    """One sentence: which recipe is best in how many of the main numbers, and what it is level with.

    What it counts is what the terminal says at the end of a run (`metrics.headline`), of more numbers.
    """
    count = wins(rows)
    total = sum(column.higher_is_better is not None for column in headline_columns(rows))
    models = [name for name, _, learned in methods_of(over_seeds(rows)) if learned]
    if not models or not total:
        return ""
    best = max(models, key=lambda name: count[name])
    seeds = len({row["seed"] for row in rows if row["recipe"] == best})
    mean = f" (mean of {seeds} seeds)" if seeds > 1 else ""
    others = ", ".join(f"{escape(name)} in {wins_}" for name, wins_ in count.items() if name != best)
    level = "".join(
        f"; it shows what {escape(name)} shows: level in {number_}"
        for name, number_ in level_with(rows, best).items()
        if number_ >= LEAST_LEVEL
    )
    css = "good" if count[best] > total / 2 else ""
    return (
        f'<div class="note {css}"><b>{escape(best)}</b>{mean} is best in {count[best]} of {total} main'
        f" numbers at the held-out frames ({others}){level}.</div>"
    )


def _data_sets(scene: SceneOutputs) -> str:
    """Links to the folders of the newest data sets; the page lies in a folder beside the scenes'."""
    links = []
    for record in scene.records:
        for key, version in sorted(record.metadata.items()):
            if record.stage.startswith("dataset") and key.endswith("_version"):
                folder = f"dataset/{key.removesuffix('_version')}/{version}"
                links.append(f'<a href="../{escape(scene.name)}/{escape(folder)}/">{escape(folder)}</a>')
    return f"<p>Scans and images: {', '.join(links)}.</p>" if links else ""


def _cost_plot(rows: Sequence[Row]) -> str:
    panels = []
    for protocol, metric, title in _COSTS:
        points = []
        for name, _, _ in methods_of(rows):
            mine = [row for row in rows if row["method"] == name]
            value = mean_of(mine, protocol, metric)[0]
            seconds = float(mine[0]["train_seconds"] or 0.0)
            colour = plots.BASELINE_COLOURS.get(mine[0]["recipe"], plots.MODEL_COLOUR)
            points.append(plots.CostPoint(label=name, seconds=seconds, error=value, colour=colour))
        if any(np.isfinite(point.error) for point in points):
            panels.append((title, points))
    if not panels:
        return ""
    picture = plot(plots.cost_error_png(panels), "error over training time")
    return figure([picture], "What each method took to prepare, and how wrong it is afterwards.")


def _loss_curve(run: FieldRun) -> str:
    caption = f"Loss of {run.recipe}, seed {run.seed}; thick: the sum that is minimised, thin: its terms."
    return figure([plot(plots.curve_png(run.curve), "loss curve")], caption)


def _stages(scene: SceneOutputs) -> str:
    if not scene.records:
        return ""
    longest = max(record.seconds for record in scene.records) or 1.0
    total = sum(record.seconds for record in scene.records)
    rows = []
    for record in scene.records:
        failed = [check for check in record.checks if not check["passed"]]
        bar = f'<span class="bar" style="width:{240 * record.seconds / longest:.0f}px"></span>'
        state = (
            f"{len(record.checks) - len(failed)} of {len(record.checks)} hold" if record.checks else "none"
        )
        details = "".join(f"<br><b>{escape(c['name'])}</b>: {escape(c['detail'])}" for c in failed)
        rows.append([escape(record.stage), number(record.seconds, 1), bar, state + details])
    rows.append(["<b>together</b>", f"<b>{number(total, 1)}</b>", "", ""])
    table = plain_table(["stage", "seconds", "", "checks"], rows, words=(2, 3))
    note = "Seconds of each stage when it last ran; a training that was resumed counts from there."
    return f"<h3>Where the time went</h3><p>{note}</p>{table}"
