"""The report's pictures of a view: scans, images, and how both differ from what was really there."""

from collections.abc import Mapping, Sequence

import numpy as np

from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.reporting import plots
from nvsf_core.reporting.html import escape, figure, image, number
from nvsf_core.reporting.previews import image_preview, scan_top_view
from nvsf_core.reporting.scene_outputs import METHODS, CameraPair, ViewPictures
from nvsf_core.reporting.tables import Row, image_scores, view_table
from nvsf_core.reporting.view_files import files_section

_OF_IMAGES = (
    " Its lasers look above those that recorded: where no return was recorded, images show the surface, with"
    " the scene's mean intensity."
)
_NOT_RECORDED = "Nobody recorded this one: rendered by {recipe} alone, nearest recorded frame {frame}."
_KNOWN = (
    "The drive did not record this one, but what its images should show is known, from another camera or from"
    " the exact world of a synthetic street. Nearest recorded frame {frame}."
)


def view_section(view: ViewPictures, recipe: str, rows: Sequence[Row]) -> str:
    """HTML of one instant of a view, and of the errors of its images where their truth is known."""
    names = {"model": recipe}
    if view.view == HELD_OUT:
        parts = [f"<h3>Held-out frame {view.frame}</h3>"]
    else:
        sensor = f", sensor {escape(view.sensor)}" if view.sensor else ""
        is_known = any(pair.truth is not None for pair in view.cameras)
        about = (_KNOWN if is_known else _NOT_RECORDED).format(recipe=escape(recipe), frame=view.frame)
        parts = [
            f"<h3>View <code>{escape(view.view)}</code>{sensor}</h3>"
            f"<p>{about}{_OF_IMAGES * view.by_images}</p>",
            view_table(rows, view.view),
        ]
    parts.append(files_section(view))
    if view.rendered_range_m:
        parts.append(_range_images(view, names))
    if view.rendered_points_m:
        parts.append(_top_views(view, names))
    for pair in view.cameras:
        if view.view == HELD_OUT or pair.truth is None:
            parts.append(_camera_pair(pair, names))
        else:
            parts.append(_compared(pair, pair.truth, recipe, image_scores(rows, view.view, pair.camera)))
    return "".join(parts)


def _range_images(view: ViewPictures, names: Mapping[str, str]) -> str:
    def strip(label: str, png: bytes) -> str:
        return f'<div class="label">{escape(label)}</div>{image(png, label, "wide")}'

    recorded = view.recorded_range_m
    folded: list[str] = []
    pictures = [] if recorded is None else [strip("recorded range", plots.range_image_png(recorded))]
    for method in METHODS:
        if method not in view.rendered_range_m:
            continue
        name, range_m = names.get(method, method), view.rendered_range_m[method]
        shown = strip(f"{name}: range", plots.range_image_png(range_m))
        (pictures if method == "model" else folded).append(shown)
        if recorded is not None:
            pictures.append(strip(f"{name}: error", plots.error_image_png(recorded, range_m)))
    ticks = [(plots.range_tick_percent(tick), f"{tick} m") for tick in plots.RANGE_TICKS_M]
    legend = _scale(plots.range_scale_png(), ticks)
    if recorded is not None:
        legend += " " + _scale(plots.error_scale_png(), [(0, "0"), (50, "0.5 m"), (100, "1 m or more")])
        legend += _key(plots.MISSED_COLOUR, "recorded, but missed") + _key(
            plots.INVENTED_COLOUR, "never recorded"
        )
    caption = (
        "What the laser scanner sees, unrolled: a full turn from left to right, straight ahead in the"
        " middle, one row an elevation. Black: nothing came back."
    )
    more = f"<details><summary>The baselines’ range images</summary>{''.join(folded)}</details>"
    return figure([*pictures, f"<div>{legend}</div>"], caption) + (more if folded else "")


def _top_views(view: ViewPictures, names: Mapping[str, str]) -> str:
    clouds = [("recorded", view.recorded_points_m)] if view.recorded_points_m is not None else []
    clouds += [(names.get(m, m), view.rendered_points_m[m]) for m in METHODS if m in view.rendered_points_m]
    cells = [
        f'<div><div class="label">{escape(name)}: {number(len(points_m), 0)} returns</div>'
        f"{image(scan_top_view(points_m), name + ' from above')}</div>"
        for name, points_m in clouds
    ]
    caption = "The same scan from above, 80 m by 80 m, driving direction up; blue is low, yellow is high."
    return figure([f'<div class="row above">{"".join(cells)}</div>'], caption)


def _compared(pair: CameraPair, truth: np.ndarray, recipe: str, scores: Mapping[str, float]) -> str:
    """Truth, model, the baseline of the highest PSNR and the model's error; `scores` are PSNR in dB."""
    baselines = [name for name in METHODS if name in pair.rendered and name in scores]
    best = max(baselines, key=lambda name: scores[name], default=None)
    pictures = [("truth", image_preview(truth))]
    for method, name in (("model", recipe), *([(best, best)] if best else [])):
        score = f": {number(scores[name], 1)} dB" if name in scores else ""
        pictures.append((f"{name}{score}", image_preview(pair.rendered[method])))
    error = plots.image_error_png(truth, pair.rendered["model"])
    pictures.append((f"{recipe}: error", error))
    legend = _scale(plots.error_scale_png(), [(0, "0"), (100, f"{plots.MAX_ERROR_LEVELS} of 255 or more")])
    caption = (
        f"Camera {pair.camera}, frame {pair.frame}: what it should show, the model, the baseline that is"
        " nearest to the truth over all images of this view, and how far the model is off."
    )
    return figure([_side_by_side(pair.camera, pictures), f"<div>{legend}</div>"], caption)


def _camera_pair(pair: CameraPair, names: Mapping[str, str]) -> str:
    pictures = [("recorded", pair.truth)] if pair.truth is not None else []
    pictures += [(names.get(m, m), pair.rendered[m]) for m in METHODS if m in pair.rendered]
    shown = [(name, image_preview(rgb)) for name, rgb in pictures]
    return figure([_side_by_side(pair.camera, shown)], f"Camera {pair.camera}, frame {pair.frame}.")


def _side_by_side(camera: str, pictures: Sequence[tuple[str, bytes]]) -> str:
    cells = [
        f'<div><div class="label">{escape(name)}</div>{image(png, f"{camera} {name}")}</div>'
        for name, png in pictures
    ]
    return f'<div class="row camera">{"".join(cells)}</div>'


def _scale(png: bytes, ticks: Sequence[tuple[float, str]]) -> str:
    marks = "".join(f'<span style="left:{left:.1f}%">{escape(text)}</span>' for left, text in ticks)
    return f'<span class="scale">{image(png, "colour scale")}{marks}</span>'


def _key(colour: tuple[int, int, int], words: str) -> str:
    return f'<span class="key"><i style="background:rgb{colour}"></i>{escape(words)}</span>'
