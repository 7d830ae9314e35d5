"""Metrics of the images of a view that was asked for, against true ones.

The truth is stored beside the metrics. It is for measuring alone: no stage that trains or renders reads it.
Rows have the protocol `image` and the view's name as `split`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.metrics.image import MISSING, image_metrics, image_part_metrics, missing_share
from nvsf_core.metrics.lpips import Lpips
from nvsf_core.rendering.rendered import Support
from nvsf_core.reporting.scene_outputs import TRUTH_NAME
from nvsf_core.stages.scoring.rows import Ledger
from nvsf_core.stores.arrays import holds_array, read_arrays, write_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueImages:
    """What one camera saw, or would have seen, at instants of a view."""

    camera: str
    """Its name."""
    row: np.ndarray
    """(n,) int64: which of the view's images each is the truth of."""
    frame: np.ndarray
    """(n,) int64: recorded frames nearest to them in time."""
    rgb: np.ndarray
    """(n, H, W, 3) uint8, undistorted as the view's images are."""
    valid: np.ndarray
    """(H, W) bool: pixels that the lens sees."""


def write_truth(folder: Path, truths: Sequence[TrueImages]) -> None:
    """Store the true images of a view in its folder, as the data contract has it."""
    arrays: dict[str, np.ndarray] = {}
    for one in truths:
        for part in ("rgb", "valid", "frame", "row"):
            arrays[f"{one.camera}_{part}"] = getattr(one, part)
    folder.mkdir(parents=True, exist_ok=True)
    write_arrays(folder / TRUTH_NAME, arrays, {"cameras": [one.camera for one in truths]})


def measure_view_images(
    path: Path, view: str, truth: TrueImages, ledger: Ledger, lpips: Lpips | None
) -> Iterator[str]:
    """Add the rows of one camera of a view, whole and by support; yields progress after each image.

    Args:
        path: Zarr group of one method's view, with images of that camera.
        view: Name of the view.
        truth: The true images.
        ledger: Receives the rows.
        lpips: The LPIPS network; None if its weights are absent.

    Raises:
        ShapeError: The images have other sizes than the true ones.
    """
    camera = truth.camera
    names = [f"{camera}_rgb", f"{camera}_render_seconds"]
    knows_support = holds_array(path, f"{camera}_support")
    a = read_arrays(path, *names, *([f"{camera}_support"] if knows_support else []))
    for i, (row, frame) in enumerate(zip(truth.row.tolist(), truth.frame.tolist(), strict=True)):
        rgb, true = a[f"{camera}_rgb"][row], truth.rgb[i]
        whole = image_metrics(rgb, true, truth.valid, lpips)
        found = {"all": {**whole, MISSING: missing_share(rgb, true, truth.valid)}}
        for support in Support if knows_support else ():
            chosen = truth.valid & (a[f"{camera}_support"][row] == support)
            found[support.region] = {**image_part_metrics(rgb, true, chosen)}
        for region, measures in found.items():
            ledger.add(
                measures, split=view, protocol="image", region=region, sensor=camera, frame=frame,
                render_seconds=float(a[f"{camera}_render_seconds"][row]),
            )  # fmt: skip
        yield f"image {i + 1} of {len(truth.row)}"
