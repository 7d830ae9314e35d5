"""A lock that allows one training at a time per device of a machine; the CPU counts as one, a pod's too."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from nvsf_core.stages.runner.locks import file_lock
from nvsf_core.stages.runner.stage import Progress
from nvsf_core.stores.writers import container_mark, machine_mark


@contextlib.contextmanager
def device_lock(folder: Path, progress: Progress) -> Iterator[str]:
    """Wait for this process's device and hold its lock; yields its name (`cpu`, `cuda0`, ...).

    `folder` has one lock file per device; processes that share devices must share the folder. A process
    trains on its first visible GPU: on a machine with several, give each worker its CUDA_VISIBLE_DEVICES.

    Raises:
        StoreError: The lock file's path is a folder or a pipe.
    """
    device = _device()
    words = f"the device {device}: another training holds it"
    with file_lock(lock_file(folder), progress, words):
        yield device


def lock_file(folder: Path) -> Path:
    """The lock file of this process's device; machines that share the folder have files of their own."""
    device = _device()
    # A pod has cores of its own, by its limits: it need not wait for another one on its node.
    is_pod = device == "cpu" and os.environ.get("NVSF_EXECUTOR") == "k8s"
    return folder / f"{device}-{container_mark() if is_pod else machine_mark()}.lock"


def _device() -> str:
    """The first CUDA device that this process may see, else `cpu`; found without initialising CUDA."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        ids = sorted(path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*"))
    else:
        ids = [part.strip() for part in visible.split(",") if part.strip() not in ("", "-1")]
    return f"cuda{ids[0]}" if ids else "cpu"
