"""Check of stored views: how much of them is guessed."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nvsf_core.geometry.camera_fan import camera_rays
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages.checks.declared import GUESSED
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stages.views.view import camera_models
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_LIMIT = 0.1


def check_support(task: Task) -> list[Check]:
    """The outcome of `GUESSED` for the model's scans and images of all views in the task's folder."""
    shares = []
    for path in sorted(task.folder.glob("*/model.zarr")):
        for kind, support in _supports(task, path):
            counts = [int(np.count_nonzero(support == one)) for one in Support]
            shares.append((counts[Support.GUESSED] / max(1, support.size), path.parent.name, kind, counts))
    if not shares:
        return [GUESSED.not_run("no view has a scan or an image with support")]
    worst, view, kind, counts = max(shares)
    words = ", ".join(f"{count:,} {one.name.lower()}" for one, count in zip(Support, counts, strict=True))
    return [GUESSED.outcome(worst, _LIMIT, f"view {view}: of its {kind} {words}")]


def _supports(task: Task, path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """What a view's supports are of, and their classes (m,); of pixels, those that the lens sees."""
    if holds_array(path, "support"):
        yield "returns", read_arrays(path, "support")["support"]
    for camera in read_attrs(path).get("cameras", []):
        name = f"{camera}_support"
        if holds_array(path, name):
            yield f"pixels of {camera}", read_arrays(path, name)[name][:, _seen_by_lens(task, path, camera)]


def _seen_by_lens(task: Task, path: Path, camera: str) -> np.ndarray:
    """(H, W) bool: pixels of a view's camera that a lens sees: nobody guesses what lies outside of it."""
    recorded, valid = task.store.require("undistorted") / "images.zarr", f"{camera}_valid"
    if holds_array(recorded, valid):
        return read_arrays(recorded, valid)[valid]
    return camera_rays(camera_models(read_attrs(path))[camera])[1]
