"""Dagster's own processes: the daemon, what it launched, two daemons at once, and the webserver."""

import os
import signal
import socket
import sys
import time
import urllib.error
import urllib.request

from benchmarks.chaos.event import Event, Harm, Random
from benchmarks.chaos.instance import newest_run, waits_or_runs
from benchmarks.chaos.processes import Running, descendants, kill, words_of
from benchmarks.chaos.world import LONGEST_RUN_S, World

_MODULE = ("-m", "pipelines.definitions")
_BEGUN_S, _ENDED_S = 240.0, 600.0
"""Longest until a changed drive has a run, and until a run whose process died was launched again."""


def kill_daemon(world: World, random: Random) -> Harm:
    """Kill the daemon, or a process below it, while a run of its own is at work; start it again."""
    daemon = _daemon(world)
    before = _change_drive(world, random)
    began = _wait_for_run(world, before)
    daemon.sleep(random.uniform(0.0, 20.0))
    what = random.choice(["the daemon and all below it", "the run", "the code server"])
    if what == "the daemon and all below it":
        daemon.kill()
        daemon = _daemon(world)
    else:
        _kill_below(daemon, "execute_run" if what == "the run" else "api grpc")
    end = _wait_for_end(world)
    _stop(daemon)
    world.restore_drive()
    return Harm(f"{what}; {began}, at the end {end}", end, "SUCCESS")


def two_daemons(world: World, random: Random) -> Harm:
    """Start two daemons on one instance and change the drive; one of the two may take over."""
    first, second = _daemon(world), _daemon(world)
    before = _change_drive(world, random)
    began = _wait_for_run(world, before)
    end = _wait_for_end(world)
    for daemon in (first, second):
        _stop(daemon)
    world.restore_drive()
    return Harm(f"{began}, at the end {end}", end, "SUCCESS")


def kill_webserver(world: World, random: Random) -> Harm:
    """Kill the webserver while a run of the terminal is at work; start it again."""
    world.provoke()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = _webserver(world, port)
    run = world.start()
    run.sleep(random.uniform(0.0, 20.0))
    server.kill()
    server = _webserver(world, port)
    serves = _serves(port)
    code = run.wait(LONGEST_RUN_S)
    _stop(server)
    words = f"the run ends with {code}, the new webserver {'serves' if serves else 'does not serve'}"
    return Harm(words, words, "with 0, .* webserver serves")


def _daemon(world: World) -> Running:
    command = [sys.executable, "-m", "dagster._daemon", "run", *_MODULE]
    more = {"NVSF_AUTOMATE": "1", "NVSF_QUIET_S": "0", "NVSF_EXECUTOR": "multiprocess", "SEED": ""}
    return world.launch(command, "daemon", **more)


def _webserver(world: World, port: int) -> Running:
    command = [sys.executable, "-m", "dagster_webserver", *_MODULE, "-h", "127.0.0.1", "-p", str(port)]
    server = world.launch(command, "webserver")
    until_s = time.monotonic() + 120.0
    while server.is_alive and not _serves(port) and time.monotonic() < until_s:
        time.sleep(0.5)
    return server


def _serves(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/server_info", timeout=5.0) as answer:
            return bool(answer.status == 200)
    except (OSError, urllib.error.URLError):
        return False


def _change_drive(world: World, random: Random) -> str:
    """Add empty lines to the poses; the newest run of before."""
    path = world.drive.poses_path
    name = path.relative_to(world.folder / "drive").as_posix()
    path.write_bytes(world.pristine[name] + b"\n" * random.randrange(1, 1000))
    return newest_run(world)[0]


def _wait_for_run(world: World, before: str) -> str:
    """Wait for a run of the daemon's; what came."""
    started_s = time.monotonic()
    while time.monotonic() - started_s < _BEGUN_S:
        run, status = newest_run(world)
        if run != before and status == "STARTED":
            return f"a run after {time.monotonic() - started_s:.0f} s"
        time.sleep(1.0)
    return f"no run within {_BEGUN_S:.0f} s"


def _wait_for_end(world: World) -> str:
    """Wait until nothing runs or waits any more; the status of the newest run."""
    until_s = time.monotonic() + _ENDED_S
    quiet = 0
    while time.monotonic() < until_s and quiet < 5:
        quiet = 0 if waits_or_runs(world) or newest_run(world)[1] == "FAILURE" else quiet + 1
        time.sleep(2.0)
    return newest_run(world)[1]


def _kill_below(daemon: Running, words: str) -> None:
    for number in descendants(daemon.process.pid):
        if words in words_of(number):
            kill(number)
            return


def _stop(process: Running) -> None:
    """End it as a user does, by SIGTERM; kill what is left."""
    below = descendants(process.process.pid)
    os.kill(process.process.pid, signal.SIGTERM)
    process.wait(30.0)
    for number in below:
        if "dagster" in words_of(number):
            kill(number)


EVENTS = [
    Event("kill_daemon", "SIGKILL to the daemon, its run or its code server", kill_daemon,
          needs_dagster=True, weight=1),
    Event("two_daemons", "two daemons on one instance", two_daemons, needs_dagster=True, weight=1),
    Event("kill_webserver", "SIGKILL to the webserver", kill_webserver, needs_dagster=True, weight=1),
]  # fmt: skip
