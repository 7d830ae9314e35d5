"""One HTML file that shows the scans of a view in three dimensions: no network, at most 15 MB."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps

from nvsf_core.reporting.html import escape
from nvsf_core.reporting.previews import SUPPORT_COLOURS
from nvsf_core.reporting.scan_page.clouds import FAR_M, Cloud, Instant

MOST_BYTES = 15_000_000
_MOST_POINTS = 1_150_000
"""Of a page: a point takes 9 bytes, 12 as text."""
_HERE = Path(__file__).parent
_RECORDED_COLOUR = (200, 205, 212)
_SUPPORTS = ("guessed", "extrapolated", "seen", "recorded")
_SCALES = {"intensity": ("dark", "bright"), "error": ("0", f"{FAR_M:g} m or more to the nearest point")}


def scan_page(title: str, words: str, instants: Sequence[Instant]) -> str:
    """The page, as HTML; `title` and `words` are text."""
    facts, points = _packed(instants)
    parts = {
        "TITLE": escape(title), "WORDS": escape(words), "SCRIPT": (_HERE / "page.js").read_text("utf-8"),
        # `<` would end the script element early.
        "FACTS": json.dumps(facts, separators=(",", ":")).replace("<", "\\u003c"),
        "POINTS": base64.b64encode(points).decode(),
    }  # fmt: skip
    pieces = (_HERE / "page.html").read_text("utf-8").split("@")
    return "".join(parts.get(piece, piece) for piece in pieces)


def _packed(instants: Sequence[Instant]) -> tuple[dict[str, Any], bytes]:
    """The page's facts, and all points: x, y, z as 16 bits each, then intensity, support, error as bytes."""
    clouds = [cloud for one in instants for cloud in (one.recorded, one.synthetic) if cloud is not None]
    step = max(1, -(-sum(len(cloud.points_m) for cloud in clouds) // _MOST_POINTS))
    points_m = [cloud.points_m[::step] for cloud in clouds]
    low_m = np.min([one.min(axis=0) for one in points_m if len(one)], axis=0, initial=0.0)
    high_m = np.max([one.max(axis=0) for one in points_m if len(one)], axis=0, initial=0.0)
    size_m = np.maximum(high_m - low_m, 1e-3)
    place = np.rint((np.concatenate(points_m) - low_m) / size_m * 65535.0).astype("<u2")
    # Square root: most surfaces are dark.
    intensity = _bytes([np.sqrt(np.clip(cloud.intensity[::step], 0.0, 1.0)) for cloud in clouds])
    support = np.concatenate([cloud.support[::step] for cloud in clouds]).astype(np.uint8)
    error = _bytes([cloud.error_m[::step] / FAR_M for cloud in clouds])
    facts = {
        "low_m": low_m.tolist(),
        "size_m": size_m.tolist(),
        "instants": _ranges(instants, step),
        "palettes": _palettes(),
        "supports": _SUPPORTS,
        "scales": _SCALES,
        "every": step,
    }
    return facts, b"".join(one.tobytes() for one in (place, intensity, support, error))


def _ranges(instants: Sequence[Instant], step: int) -> list[dict[str, Any]]:
    """Of each instant its time, and first point and number of points of both clouds."""
    found, first = [], 0

    def taken(cloud: Cloud | None) -> list[int]:
        nonlocal first
        count = 0 if cloud is None else len(cloud.points_m[::step])
        first += count
        return [first - count, count]

    for one in instants:
        sides = {"recorded": taken(one.recorded), "synthetic": taken(one.synthetic)}
        found.append({"time_s": one.time_s, "frame": one.frame, **sides})
    return found


def _bytes(values: Sequence[np.ndarray]) -> np.ndarray:
    return np.rint(np.concatenate(values) * 255.0).astype(np.uint8)


def _palettes() -> dict[str, list[list[int]]]:
    """256 colours of each mode."""
    support = np.zeros((256, 3), np.int64)
    support[: len(_SUPPORTS)] = (*SUPPORT_COLOURS, _RECORDED_COLOUR)
    maps = {"intensity": "viridis", "error": "RdYlGn_r"}
    shown = {name: colormaps[given](np.linspace(0.0, 1.0, 256))[:, :3] * 255 for name, given in maps.items()}
    palettes = {"intensity": shown["intensity"], "support": support, "error": shown["error"]}
    return {name: np.rint(values).astype(int).tolist() for name, values in palettes.items()}
