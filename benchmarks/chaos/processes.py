"""Processes that chaos starts, and the ones below them; only these are ever killed."""

import contextlib
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

_POLL_S = 0.1
_LOOK_S = 0.5


class Forked:
    """A forked process, to be asked as a `subprocess.Popen` is."""

    def __init__(self, work: Callable[[], None], log: Path, environment: Mapping[str, str]) -> None:
        """Do the work in a process of its own, which loads no library again."""
        self._code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            _work(work, log, environment)

    def poll(self) -> int | None:
        """Its exit code; None while it is at work."""
        if self._code is None:
            number, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if number else None
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, once it has ended.

        Raises:
            subprocess.TimeoutExpired: It is still at work after so many seconds.
        """
        until_s = time.monotonic() + (float("inf") if timeout is None else timeout)
        while (code := self.poll()) is None:
            if time.monotonic() > until_s:
                raise subprocess.TimeoutExpired("forked", timeout or 0.0)
            time.sleep(_POLL_S)
        return code


def _work(work: Callable[[], None], log: Path, environment: Mapping[str, str]) -> None:
    """In the child: work, say what went wrong, and leave without the parent's clean-up."""
    code = 1
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        os.environ.update(environment)
        work()
        code = 0
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


@dataclass(slots=True)
class Running:
    """A command in a session of its own; what it says is kept in a file."""

    process: subprocess.Popen[bytes] | Forked
    log: Path

    @classmethod
    def start(cls, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> "Running":
        """Start a command; all it says goes to `log`."""
        with log.open("ab") as handle:
            process = subprocess.Popen(
                list(command), env=dict(environment), stdout=handle, stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
        return cls(process, log)

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    @property
    def said(self) -> str:
        """All it has said so far."""
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    def wait(self, seconds: float) -> int | None:
        """Its exit code; None, and everything of it is killed, if it is still at work after so long.

        Seconds in which the machine was busy with other programs, and a process of it waited for a
        processor, do not count: that a run is slow then is no fault of its own.
        """
        until_s, before_s = time.monotonic() + seconds, dict[int, float]()
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                return self.process.wait(_LOOK_S)
            own = [self.process.pid, *descendants(self.process.pid)]
            now_s = {number: starved_s(number) for number in own}
            until_s += max(now_s[one] - before_s.get(one, now_s[one]) for one in own)
            before_s = now_s
            if time.monotonic() > until_s:
                self.kill()
                return None

    def wait_for(self, word: str, seconds: float) -> bool:
        """Whether it says a word within so many seconds."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s and self.is_alive:
            if word in self.said:
                return True
            time.sleep(_POLL_S)
        return word in self.said

    def sleep(self, seconds: float) -> None:
        """Wait so long, or until it ends."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s and self.is_alive:
            time.sleep(_POLL_S)

    def kill(self) -> None:
        """SIGKILL to it and to all below it at once, as when the power goes."""
        below = descendants(self.process.pid)
        for number in [self.process.pid, *below]:
            kill(number)
        self.process.wait()


def descendants(number: int) -> list[int]:
    """Processes below one, the nearest first."""
    parents: dict[int, list[int]] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(fields[1]), []).append(int(folder.name))
    found, rest = [], [number]
    while rest:
        below = parents.get(rest.pop(0), [])
        found += below
        rest += below
    return found


def starved_s(number: int) -> float:
    """Seconds that a process was ready and no processor was free for it; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{number}/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError):
        return 0.0


def kill(number: int) -> None:
    """SIGKILL to one process; one that has just ended is no error."""
    try:
        os.kill(number, signal.SIGKILL)
    except ProcessLookupError:
        return


def words_of(number: int) -> str:
    """The command line of a process; empty if it has ended."""
    try:
        return Path(f"/proc/{number}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""
