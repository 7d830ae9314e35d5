"""How long chaos waits for a run: what hangs is ended, what other programs keep from processors is not."""

import os
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.chaos.processes import Running, starved_s

_WORKS = "import time\nwhile time.process_time() < 0.5: pass"


def _started(tmp_path: Path, code: str) -> Running:
    return Running.start([sys.executable, "-c", code], tmp_path / "said.txt", dict(os.environ))


def test_what_hangs_is_ended(tmp_path: Path) -> None:
    started_s = time.monotonic()
    run = _started(tmp_path, "import time; time.sleep(60)")
    assert run.wait(1.0) is None and not run.is_alive
    assert time.monotonic() - started_s < 30.0


def test_what_waits_for_a_processor_is_waited_for(tmp_path: Path) -> None:
    core = {min(os.sched_getaffinity(0))}
    held = f"import os; os.sched_setaffinity(0, {core})"
    run = _started(tmp_path, f"{held}\n{_WORKS}")
    # One core, and four others upon it: half a second of work takes two and more.
    others = [
        subprocess.Popen(
            [sys.executable, "-c", f"import os; os.sched_setaffinity(0, {core})\nwhile True: pass"]
        )
        for _ in range(4)
    ]
    try:
        started_s = time.monotonic()
        assert run.wait(1.5) == 0
        assert time.monotonic() - started_s > 1.5, "else it had its core to itself, and this shows nothing"
    finally:
        for one in others:
            one.kill()
            one.wait()
    assert starved_s(run.process.pid) == 0.0, "it has ended"
