"""Refuse to begin an output that does not fit on the disk, with figures."""

import shutil

from nvsf_core.errors import StoreError
from nvsf_core.stages.runner.stage import Stage, Task

SPARE_BYTES = 500_000_000
"""Left free beside what is written: Dagster's history and other runs write, too."""
_MB = 1e6


def require_space(stage: Stage, task: Task) -> None:
    """Compare a stage's estimate of what it will write with the free space of the home's disk.

    Raises:
        StoreError: It does not fit; the message has both figures.
    """
    if stage.estimate_bytes is None:
        return
    needed = stage.estimate_bytes(task)
    free = shutil.disk_usage(task.store.home).free
    if needed + SPARE_BYTES > free:
        raise StoreError(
            f"scene {task.scene.name}, stage {stage.name}: not begun, for it writes about "
            f"{needed / _MB:,.0f} MB, and {task.store.home} has {free / _MB:,.0f} MB free, of which "
            f"{SPARE_BYTES / _MB:,.0f} MB are kept; free space, or move NVSF_HOME to a larger disk"
        )
