"""A stage that is at work says so, even while it has nothing to report."""

import threading
import time
from collections.abc import Callable
from types import TracebackType

SILENCE_S = 4.0
"""After so many seconds without a line one is said: who waits should never wonder longer than five."""


class Heartbeat:
    """Passes progress on, and speaks up after `SILENCE_S` of silence until the `with` ends."""

    def __init__(self, progress: Callable[[str], None], name: str, silence_s: float = SILENCE_S) -> None:
        """Wrap a progress.

        Args:
            progress: Takes all lines, also from a thread of its own.
            name: Who is at work: `[demo] evidence`.
            silence_s: Longest silence.
        """
        self._progress, self._name, self._silence_s = progress, name, silence_s
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._started = self._said = time.monotonic()
        self._thread = threading.Thread(target=self._watch, name=f"heartbeat {name}", daemon=True)

    def __call__(self, line: str, /) -> None:
        """Say a line."""
        with self._lock:
            self._said = time.monotonic()
            self._progress(line)

    def __enter__(self) -> "Heartbeat":
        """Begin to watch."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop watching."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.1 * self._silence_s):
            now = time.monotonic()
            if now - self._said >= self._silence_s:
                self(f"{self._name}: at work for {now - self._started:.0f} s")
