"""Check of stored views: how much of them is guessed."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nvsf_core.rendering.rendered import Support
from nvsf_core.stages.checks.declared import GUESSED
from nvsf_core.stages.runner.stage import Check, Task
from nvsf_core.stores.arrays import holds_array, read_arrays, read_attrs

_LIMIT = 0.1


def check_support(task: Task) -> list[Check]:
    """The outcome of `GUESSED` for the model's scans and images of all views in the task's folder."""
    shares = []
    for path in sorted(task.folder.glob("*/model.zarr")):
        for kind, name in _supports(path):
            support = read_arrays(path, name)[name]
            counts = [int(np.count_nonzero(support == one)) for one in Support]
            shares.append((counts[Support.GUESSED] / max(1, support.size), path.parent.name, kind, counts))
    if not shares:
        return [GUESSED.not_run("no view has a scan or an image with support")]
    worst, view, kind, counts = max(shares)
    words = ", ".join(f"{count:,} {one.name.lower()}" for one, count in zip(Support, counts, strict=True))
    return [GUESSED.outcome(worst, _LIMIT, f"view {view}: of its {kind} {words}")]


def _supports(path: Path) -> Iterator[tuple[str, str]]:
    """What a view's arrays of support are of, and their names."""
    if holds_array(path, "support"):
        yield "returns", "support"
    for camera in read_attrs(path).get("cameras", []):
        if holds_array(path, f"{camera}_support"):
            yield f"pixels of {camera}", f"{camera}_support"
