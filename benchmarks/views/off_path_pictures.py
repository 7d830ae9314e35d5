"""Pictures of views off the recorded path: truth, model, best baseline, and the model's error.

``SCENES=street RECIPE=quick python -m benchmarks.views.off_path_pictures`` reads what a run of the embedded
street rendered and measured (`NVSF_HOME`), prints PSNR, and writes docs/pictures/off_path.jpg, which
docs/results.md shows.
"""

import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.common.documents import ROOT
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.metrics.elementwise import psnr
from nvsf_core.metrics.table import BASELINES
from nvsf_core.stores.arrays import holds_array, read_arrays
from nvsf_core.stores.scene_store import SceneStore

PICTURE = ROOT / "docs" / "pictures" / "off_path.jpg"
_SHOWN = (("shift_1m", 0), ("shift_3m", 0), ("right_1m", 1), ("yaw_15", 0), ("between", 2), ("frozen", 3))
"""Views, and the number of the image that is shown of each."""
_CAMERA = "image_00"
_WIDTH_PX, _HEAD_PX, _GAP_PX = 440, 14, 4
_ERROR_GAIN = 2.0
_JPEG_QUALITY = 85


def main() -> None:
    """Write the picture, and print the errors that stand in it."""
    scene, recipe = os.environ.get("SCENES") or "street", os.environ.get("RECIPE") or "quick"
    root = SceneStore(home=home_from_environment(os.environ), scene=scene).root
    rows = [_row(root, recipe, view, number) for view, number in _SHOWN]
    whole = np.concatenate(rows)
    PICTURE.parent.mkdir(exist_ok=True)
    Image.fromarray(whole).save(PICTURE, quality=_JPEG_QUALITY)
    print(f"{PICTURE}: {whole.shape[1]} x {whole.shape[0]} px, {PICTURE.stat().st_size / 1e3:.0f} KB")


def _row(root: Path, recipe: str, view: str, number: int) -> np.ndarray:
    """One image of a view, by truth, model and best baseline, and the model's error, (h, w, 3) uint8."""
    folder = Path(recipe) / "0" / view
    stored = read_arrays(
        root / "scene_metrics" / folder / "truth.zarr", f"{_CAMERA}_rgb", f"{_CAMERA}_valid", f"{_CAMERA}_row"
    )
    truth, valid = stored[f"{_CAMERA}_rgb"][number], stored[f"{_CAMERA}_valid"]
    place = int(stored[f"{_CAMERA}_row"][number])
    images = {}
    for method in ("model", *BASELINES):
        path = root / "novel_views" / folder / f"{method}.zarr"
        if path.is_dir() and holds_array(path, f"{_CAMERA}_rgb"):
            images[method] = read_arrays(path, f"{_CAMERA}_rgb")[f"{_CAMERA}_rgb"][place]
    errors_db = {
        name: psnr(image[valid] / 255.0, truth[valid] / 255.0, 1.0).value for name, image in images.items()
    }
    best = max((name for name in images if name != "model"), key=lambda name: errors_db[name])
    model = images["model"]
    error = np.abs(model.astype(np.float64) - truth).max(axis=-1, keepdims=True).repeat(3, axis=-1)
    parts = [
        (f"{view}: truth", truth),
        (f"{recipe}, {errors_db['model']:.1f} dB", model),
        (f"{best}, {errors_db[best]:.1f} dB", images[best]),
        (
            f"error of {recipe}, times {_ERROR_GAIN:.0f}",
            np.minimum(_ERROR_GAIN * error, 255.0).astype(np.uint8),
        ),
    ]
    print(view, ", ".join(f"{name} {value:.2f} dB" for name, value in errors_db.items()))
    return np.concatenate([_labelled(text, image) for text, image in parts], axis=1)


def _labelled(text: str, image: np.ndarray) -> np.ndarray:
    """An image (H, W, 3), scaled, below a line of text."""
    height_px = round(_WIDTH_PX * image.shape[0] / image.shape[1])
    whole = Image.new("RGB", (_WIDTH_PX + _GAP_PX, _HEAD_PX + height_px), "white")
    ImageDraw.Draw(whole).text((2, 1), text, fill="black")
    whole.paste(
        Image.fromarray(image).resize((_WIDTH_PX, height_px), Image.Resampling.LANCZOS), (0, _HEAD_PX)
    )
    return np.asarray(whole)


if __name__ == "__main__":
    main()
