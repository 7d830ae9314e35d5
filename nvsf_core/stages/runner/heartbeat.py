"""Progress lines at regular intervals while a stage works, even if it reports nothing."""

import threading
import time
from collections.abc import Callable
from types import TracebackType

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


class Heartbeat:
    """Passes progress lines on; inside `with` it adds a line after `silence_s` without one."""

    def __init__(self, progress: Callable[[str], None], name: str, silence_s: float = SILENCE_S) -> None:
        """Wrap a progress; after `silence_s` a thread adds lines that begin with `name`."""
        self._progress, self._name, self._silence_s = progress, name, silence_s
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._started = self._said = time.monotonic()
        self._thread = threading.Thread(target=self._watch, name=f"heartbeat {name}", daemon=True)

    def __call__(self, line: str, /) -> None:
        """Pass on a line."""
        with self._lock:
            self._said = time.monotonic()
            self._progress(line)

    def __enter__(self) -> "Heartbeat":
        """Start the watching thread."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the watching thread."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.1 * self._silence_s):
            now = time.monotonic()
            if now - self._said >= self._silence_s:
                self(f"{self._name}: at work for {now - self._started:.0f} s")
