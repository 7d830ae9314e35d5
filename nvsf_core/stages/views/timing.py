"""Renders the scans or images of a view beside each other, and times them."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from nvsf_core.kernels.threads import MOST_VIEWS, in_parts
from nvsf_core.stages.runner.stage import Task

_One = TypeVar("_One")


def render_all(
    task: Task, render: Callable[[int], _One], count: int, name: str
) -> tuple[list[_One], np.ndarray]:
    """What `render` gives for the numbers 0 to `count` - 1, and the seconds (count,) that each took.

    Several are rendered at once, so each is said to take an equal share of the time of all.

    Args:
        task: Task of the stage, for its progress.
        render: Renders one.
        count: How many.
        name: Of view, method and sensor, for progress.
    """
    started, done, lock = time.perf_counter(), 0, threading.Lock()

    def one(number: int) -> _One:
        nonlocal done
        found = render(number)
        with lock:
            done += 1
            seconds = (time.perf_counter() - started) / done
            task.progress(f"[{task.scene.name}] novel_views: {name} {done}/{count}, {seconds:.2f} s each")
        return found

    found = in_parts(one, count, MOST_VIEWS)
    return found, np.full(count, (time.perf_counter() - started) / max(1, count))
