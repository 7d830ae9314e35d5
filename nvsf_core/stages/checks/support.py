"""Check of stored views: how much of them is guessed."""

import numpy as np

from nvsf_core.rendering.support import Support
from nvsf_core.stages.runner.stage import Check, NamedCheck, Task
from nvsf_core.stores.arrays import array_names, read_arrays

GUESSED = NamedCheck(
    name="little_of_a_view_is_guessed",
    description="Share of a view's returns that are guessed, where nothing was recorded: the worst view. "
    "Limit: a tenth; a model trained on such scans learns from the guesses, too.",
)
_LIMIT = 0.1


def check_support(task: Task) -> list[Check]:
    """The outcome of `GUESSED` for the model's scans of all views in the task's folder."""
    shares = []
    for path in sorted(task.folder.glob("*/model.zarr")):
        if "support" in array_names(path, "u"):
            support = read_arrays(path, "support")["support"]
            counts = [int(np.count_nonzero(support == one)) for one in Support]
            shares.append((counts[Support.GUESSED] / max(1, len(support)), path.parent.name, counts))
    if not shares:
        return [GUESSED.not_run("no view has a scan with support")]
    worst, view, counts = max(shares)
    words = ", ".join(f"{count:,} {one.name.lower()}" for one, count in zip(Support, counts, strict=True))
    return [GUESSED.outcome(worst, _LIMIT, f"view {view}: of its returns {words}")]
