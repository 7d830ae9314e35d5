"""Preview pictures of stage outputs, each a PNG below 100 kB so that it fits in Dagster's event log."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

MAX_BYTES = 100_000
MAX_RANGE_M = 80.0
_MOST_WIDE = 704
SUPPORT_COLOURS = ((214, 62, 50), (240, 190, 60), (48, 120, 190))
"""Of guessed, extrapolated and seen returns; rays without a return have a third of the brightness."""
_SPLIT_COLOURS = {"train": "#2a6f97", "test": "#d9822b"}
_SPLIT_WORDS = {"train": "training", "test": "held out"}
_USE_MARKS = {"whole": ("o", True), "part": ("o", False), "none": ("x", True)}
_USE_WORDS = {"whole": "", "part": ", something left out", "none": ", nothing usable"}


def range_preview(range_m: np.ndarray, row_repeat: int = 4) -> bytes:
    """PNG of a range image (H, W) in metres: near violet, far red, no return (0, inf, NaN) black."""
    valid = np.isfinite(range_m) & (range_m > 0.0)
    near = np.where(valid, range_m, 1.0)
    # Square root: half of the returns lie within 15 m and would share two colours otherwise.
    level = np.sqrt(np.clip(near / MAX_RANGE_M, 0.0, 1.0))
    return indexed_png(np.where(valid, 1 + np.rint(level * 254), 0), "turbo", row_repeat)


def support_preview(support: np.ndarray, returned: np.ndarray, row_repeat: int = 4) -> bytes:
    """PNG of rays or pixels by support: guessed red, extrapolated yellow, seen blue; dark without a return.

    Args:
        support: (L, F) 0 guessed, 1 extrapolated, 2 seen; lasers from the top, in order of firing, or pixels.
        returned: (L, F) bool, whether the ray shows a return.
        row_repeat: Pixels that a row is high.
    """
    colours = np.array(SUPPORT_COLOURS)
    palette = np.concatenate([colours // 3, colours])
    return palette_png(np.where(returned, 3 + support, support), palette, row_repeat)


def scan_top_view(points_m: np.ndarray) -> bytes:
    """PNG of points (N, 3) in the sensor's frame, metres, from above, coloured by height: -2.5 to 4 m."""
    points_m = points_m[np.isfinite(points_m).all(axis=1)]
    level = 1 + np.rint(np.clip((points_m[:, 2] + 2.5) / 6.5, 0.0, 1.0) * 254).astype(np.int64)
    return indexed_png(top_view_levels(points_m, level, 40.0, 480), "viridis", darkest=0.2)


def top_view_levels(points_m: np.ndarray, level: np.ndarray, extent_m: float, pixels: int) -> np.ndarray:
    """The highest level in each cell (pixels, pixels) int64 seen from above, forward up; 0 = no point.

    Of points (N, 3) in the sensor's frame, metres, with levels (N,) int64; `extent_m` is from the sensor to
    the picture's border.
    """
    cell = np.floor((extent_m - points_m[:, :2]) / (2.0 * extent_m) * pixels).astype(np.int64)
    inside = ((cell >= 0) & (cell < pixels)).all(axis=1)
    levels = np.zeros((pixels, pixels), np.int64)
    np.maximum.at(levels, (cell[inside, 0], cell[inside, 1]), level[inside])
    return levels


def image_preview(rgb: np.ndarray) -> bytes:
    """PNG of an image (H, W, 3) uint8, scaled down until it fits."""
    picture = Image.fromarray(rgb)
    width = min(_MOST_WIDE, picture.width)
    while True:
        height = max(1, round(picture.height * width / picture.width))
        content = _png_bytes(picture.resize((width, height), Image.Resampling.LANCZOS))
        if len(content) < MAX_BYTES:
            return content
        width = int(width * 0.8)


def empty_figure(width_in: float, height_in: float, dpi: int) -> Figure:
    """An empty figure that can be drawn without a display; `figure_png` makes its PNG."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def figure_png(figure: Figure) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def path_preview(
    path_m: np.ndarray, frames: Sequence[int], splits: Sequence[str], uses: Sequence[str]
) -> bytes:
    """PNG of the drive from above: a mark per frame, with its split as colour and its use as shape.

    Args:
        path_m: (N, 2) scene-local positions, metres, x to the right, y up.
        frames: Frame numbers; the first and the last are written beside their marks.
        splits: `train` or `test`, per frame.
        uses: `whole` (all data of the frame are usable), `part` or `none`, per frame.
    """
    figure = empty_figure(6.0, 4.0, 90)
    axes = figure.add_subplot()
    axes.plot(path_m[:, 0], path_m[:, 1], color="#c3cad3", linewidth=1.0, zorder=1)
    for split, colour in _SPLIT_COLOURS.items():
        for use, (mark, filled) in _USE_MARKS.items():
            mine = [row for row in range(len(path_m)) if (splits[row], uses[row]) == (split, use)]
            if mine:
                axes.plot(
                    path_m[mine, 0], path_m[mine, 1], mark, color=colour, markersize=6.0,
                    markerfacecolor=colour if filled else "white",
                    label=f"{_SPLIT_WORDS[split]}{_USE_WORDS[use]}: {len(mine)}",
                )  # fmt: skip
    for row in {0, len(path_m) - 1} if len(path_m) else ():
        axes.annotate(
            f"frame {frames[row]}", path_m[row], xytext=(5, 7), textcoords="offset points", fontsize=8
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.15)
    axes.set_xlabel("x [m], scene-local")
    axes.set_ylabel("y [m]")
    axes.grid(alpha=0.3)
    if len(path_m):
        axes.legend(fontsize=8)
    return figure_png(figure)


def indexed_png(levels: np.ndarray, colours: str, row_repeat: int = 1, darkest: float = 0.0) -> bytes:
    """Palette PNG of levels 0..255 (H, W): 0 is black, 1..255 run through a matplotlib colour map.

    `darkest` (0..1) is the place of level 1 in the map: above 0 it differs from the black background.
    """
    palette = np.zeros((256, 3), np.uint8)
    palette[1:] = np.rint(colormaps[colours](np.linspace(darkest, 1.0, 255))[:, :3] * 255)
    return palette_png(levels, palette, row_repeat)


def palette_png(levels: np.ndarray, palette: np.ndarray, row_repeat: int = 1) -> bytes:
    """PNG of indices (H, W) into a palette (K, 3) uint8, each row repeated; thinned until it fits."""
    index = np.repeat(levels.astype(np.uint8), row_repeat, axis=0)
    while True:
        picture = Image.fromarray(index)
        picture.putpalette(palette.astype(np.uint8).tobytes())
        content = _png_bytes(picture)
        if len(content) < MAX_BYTES:
            return content
        index = index[::2, ::2]


def _png_bytes(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    # `optimize` would take eight times as long for 4 % fewer bytes.
    picture.save(buffer, format="png")
    return buffer.getvalue()
