"""Progress lines at regular intervals while a stage works, even if it reports nothing."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

SILENCE_S = 4.0
"""Longest time without a progress line: nobody should have to wait for one longer than 5 s."""


def sparse(progress: Callable[[str], None], every_s: float = SILENCE_S) -> Callable[[str], None]:
    """Pass on a line only if `every_s` seconds have passed since the last one, or since this call."""
    said_s = time.monotonic()

    def say(line: str) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= every_s:
            said_s = time.monotonic()
            progress(line)

    return say


@contextlib.contextmanager
def heartbeat(
    progress: Callable[[str], None], name: str, silence_s: float = SILENCE_S
) -> Iterator[Callable[[str], None]]:
    """Pass progress lines on; after `silence_s` without one, a thread adds lines that begin with `name`."""
    lock, ended = threading.Lock(), threading.Event()
    started_s = said_s = time.monotonic()

    def say(line: str, /) -> None:
        nonlocal said_s
        with lock:
            said_s = time.monotonic()
            progress(line)

    def watch() -> None:
        while not ended.wait(0.1 * silence_s):
            now_s = time.monotonic()
            if now_s - said_s >= silence_s:
                say(f"{name}: at work for {now_s - started_s:.0f} s")

    thread = threading.Thread(target=watch, name=f"heartbeat {name}", daemon=True)
    thread.start()
    try:
        yield say
    finally:
        ended.set()
        thread.join()
