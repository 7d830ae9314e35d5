"""Runs one case in a process of its own with limits of time and memory, and says how it ended."""

import multiprocessing
import os
import resource
import signal
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NoReturn

from nvsf_core.errors import NvsfError

SECONDS = 60.0
"""A case takes one or two; a machine with busy neighbours ten times as long."""
GIGABYTES = 3.0
"""Of address space beyond what the libraries map."""


@dataclass(frozen=True, slots=True)
class End:
    """How a case ended."""

    kind: str
    """`refused`, `doubted`, `healed`, `harmless`; `silent`, `raw error`, `hang`, `crash`."""
    words: str = ""
    """The error's, or what was doubted."""


def run_limited(case: Callable[[], End], seconds: float = SECONDS) -> End:
    """Run a case in a forked process and say how it ended; after `seconds` it is killed: `hang`.

    The case says itself how it ended; an NvsfError is `refused`, any other exception a `raw error`.
    """
    receiving, sending = multiprocessing.Pipe(duplex=False)
    child = os.fork()
    if child == 0:
        _work(case, sending)
    sending.close()
    has_spoken = receiving.poll(seconds)  # also where the child died: the pipe then ends
    try:
        told = receiving.recv() if has_spoken else None
    except EOFError:
        told = None
    if not has_spoken:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if told is not None:
        return End(**told)
    if not has_spoken:
        return End("hang", f"more than {seconds:.0f} s")
    return End("crash", f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit {status}")


def _work(case: Callable[[], End], sending: Connection) -> NoReturn:
    """In the child: run, say how it ended, and leave without the parent's clean-up, whatever happens."""
    try:
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        limit = mapped + int(GIGABYTES * (1 << 30))
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        # Decoders write their complaints to standard error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sending.send(asdict(_ended(case)))
        os._exit(0)
    finally:
        os._exit(1)


def _ended(case: Callable[[], End]) -> End:
    try:
        return case()
    except NvsfError as error:
        return End("refused", f"{type(error).__name__}: {str(error)[:400]}")
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if "nvsf_core" in frame.filename]
        places = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in (*own[-1:], frames[-1])]
        return End("raw error", f"{type(error).__name__}: {str(error)[:200]} ({', '.join(places)})")
