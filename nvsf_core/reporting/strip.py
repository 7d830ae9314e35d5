"""A short animation of a view: recorded beside synthetic, image and range image, instant by instant."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from nvsf_core.reporting.plots import range_image_png
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs, read_part

MOST_STEPS = 16
"""Of a longer view, so many instants are shown, evenly apart."""
_WIDTH, _GAP, _HEAD = 880, 8, 18
_STEP_MS = 500
_QUALITY = 72
_BACK, _INK = (246, 247, 249), (28, 36, 48)


def strip_of(root: Path, view: Path) -> bytes | None:
    """An animated WebP of a view; None if it has less than two instants, or nothing recorded to compare.

    Beside each instant stands the recorded frame that is nearest.

    Raises:
        StoreError: What is stored is damaged.
    """
    path = view / "model.zarr"
    attrs = read_attrs(path)
    frames = read_arrays(path, "frame")["frame"]
    steps = np.unique(np.linspace(0, len(frames) - 1, MOST_STEPS).round().astype(int)).tolist()
    if len(steps) < 2:
        return None
    camera = next(iter(attrs.get("cameras", [])), None)
    rows = []
    if camera is not None:
        rows.append(_images(root / "undistorted" / "images.zarr", path, camera, steps, frames))
    if attrs.get("sensor"):
        rows.append(_ranges(root / "pano" / "pano.zarr", path, steps, frames))
    rows = [row for row in rows if row]
    return _animated([_stacked(parts) for parts in zip(*rows, strict=True)]) if rows else None


def _images(
    known: Path, path: Path, camera: str, steps: Sequence[int], frames: np.ndarray
) -> list[Image.Image]:
    """Recorded image on the left, rendered image on the right; empty if the camera recorded nothing."""
    name = f"{camera}_frame"
    if not known.is_dir() or not holds_array(known, name):
        return []
    recorded, rendered = read_arrays(known, name)[name], read_arrays(path, name)[name]
    if not len(recorded) or not len(rendered):
        return []
    found = []
    is_at_all = np.array_equal(rendered, frames)
    for step in steps:
        frame = int(frames[step])
        # Two instants may share their nearest frame.
        own, other = _nearest(recorded, frame), step if is_at_all else _nearest(rendered, frame)
        pictures = [
            Image.fromarray(read_part(group, slice(row, row + 1), f"{camera}_rgb")[f"{camera}_rgb"][0])
            for group, row in ((known, own), (path, other))
        ]
        found.append(_beside(pictures, (f"recorded, frame {recorded[own]}", "synthetic")))
    return found


def _ranges(known: Path, path: Path, steps: Sequence[int], frames: np.ndarray) -> list[Image.Image]:
    """Recorded range image above the rendered one; empty without recorded scans."""
    recorded = read_arrays(known, "frame")["frame"] if known.is_dir() else np.zeros(0)
    if not len(recorded):
        return []
    found = []
    for step in steps:
        row = _nearest(recorded, int(frames[step]))
        shown = (
            (read_part(known, slice(row, row + 1), "linear_range_m")["linear_range_m"][0], "recorded range"),
            (read_part(path, slice(step, step + 1), "pano_range_m")["pano_range_m"][0], "synthetic range"),
        )
        pictures = [
            _labelled(_scaled(Image.open(io.BytesIO(range_image_png(one))), _WIDTH), name)
            for one, name in shown
        ]
        found.append(_stacked(pictures))
    return found


def _nearest(frames: np.ndarray, frame: int) -> int:
    return int(np.argmin(np.abs(frames - frame)))


def _beside(pictures: Sequence[Image.Image], names: Sequence[str]) -> Image.Image:
    width = (_WIDTH - _GAP) // 2
    parts = [_labelled(_scaled(picture, width), name) for picture, name in zip(pictures, names, strict=True)]
    joined = Image.new("RGB", (_WIDTH, max(part.height for part in parts)), _BACK)
    for column, part in enumerate(parts):
        joined.paste(part, (column * (width + _GAP), 0))
    return joined


def _stacked(pictures: Sequence[Image.Image]) -> Image.Image:
    joined = Image.new("RGB", (_WIDTH, sum(one.height for one in pictures)), _BACK)
    top = 0
    for one in pictures:
        joined.paste(one, (0, top))
        top += one.height
    return joined


def _scaled(picture: Image.Image, width: int) -> Image.Image:
    height = max(1, round(picture.height * width / picture.width))
    return picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)


def _labelled(picture: Image.Image, text: str) -> Image.Image:
    """The picture below a line of text."""
    whole = Image.new("RGB", (picture.width, picture.height + _HEAD), _BACK)
    ImageDraw.Draw(whole).text((1, 3), text, fill=_INK)
    whole.paste(picture, (0, _HEAD))
    return whole


def _animated(frames: Sequence[Image.Image]) -> bytes:
    buffer = io.BytesIO()
    frames[0].save(
        buffer, format="webp", save_all=True, append_images=frames[1:], duration=_STEP_MS, loop=0,
        quality=_QUALITY,
    )  # fmt: skip
    return buffer.getvalue()
