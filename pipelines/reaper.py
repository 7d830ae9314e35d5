"""`stale_run_reaper`: runs whose processes are gone are marked as failed.

`dagster job execute` that is killed (SIGKILL, power) leaves its run STARTED for ever: it holds its pool slots
and counts against `max_concurrent_runs`. Dagster's own run monitoring looks after runs that the daemon
launched, not after these.
"""

import os
import socket
import time
from pathlib import Path

import dagster as dg

HOST_TAG = "nvsf/host"
"""`<host name>/<boot>` of the machine that holds a run's processes."""
_LOCAL_EXECUTORS = ("", "in_process", "multiprocess")
_QUIET_S = 60.0
"""Between two processes of a run, for example while a step's is started, none may be there for a moment."""
_CLOCK_SLACK_S = 2.0
"""The kernel gives the boot's time in whole seconds."""
_MESSAGE = (
    "The run's processes are gone (killed, or the machine went down). Run it again: what was finished is "
    "skipped, and training resumes."
)


def host_tags() -> dict[str, str]:
    """Tags for a job whose runs stay on this machine; none where the executor sends steps to others."""
    if os.environ.get("NVSF_EXECUTOR", "") not in _LOCAL_EXECUTORS:
        return {}
    return {HOST_TAG: f"{socket.gethostname()}/{_boot()}"}


@dg.sensor(
    minimum_interval_seconds=60,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Marks runs as failed whose processes on this machine are gone, and frees their pool slots.",
)
def stale_run_reaper(context: dg.SensorEvaluationContext) -> dg.SkipReason:
    """Reap; no run is ever asked for."""
    reaped = reap(context.instance)
    return dg.SkipReason(f"marked as failed: {', '.join(reaped)}" if reaped else "no stale run")


def reap(instance: dg.DagsterInstance, quiet_s: float = _QUIET_S) -> list[str]:
    """Mark stale runs as failed.

    Args:
        instance: Whose runs.
        quiet_s: A run that said something less long ago is left alone.

    Returns:
        Ids of the runs that were marked.
    """
    started = dg.RunsFilter(statuses=[dg.DagsterRunStatus.STARTED, dg.DagsterRunStatus.CANCELING])
    reaped = []
    for run in instance.get_runs(started):
        if not _is_stale(instance, run, quiet_s):
            continue
        instance.report_run_failed(run, _MESSAGE)
        storage = instance.event_log_storage
        if storage.supports_global_concurrency_limits:
            storage.free_concurrency_slots_for_run(run.run_id)
        reaped.append(run.run_id)
    return reaped


def _is_stale(instance: dg.DagsterInstance, run: dg.DagsterRun, quiet_s: float) -> bool:
    host, _, boot = run.tags.get(HOST_TAG, "").rpartition("/")
    if host != socket.gethostname():
        return False
    entries = instance.all_logs(run.run_id)
    if time.time() - max((entry.timestamp for entry in entries), default=0.0) < quiet_s:
        return False
    if boot != _boot():
        return True
    spoke_s: dict[int, float] = {}
    for entry in entries:
        if entry.dagster_event is not None and entry.dagster_event.pid is not None:
            spoke_s[entry.dagster_event.pid] = entry.timestamp
    return not any(_is_alive(pid, moment_s) for pid, moment_s in spoke_s.items())


def _is_alive(pid: int, spoke_s: float) -> bool:
    """Whether the process that spoke then still runs: not a zombie, and no later one that got its number."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False
    booted_s = next(
        float(line.split()[1])
        for line in Path("/proc/stat").read_text().splitlines()
        if line.startswith("btime")
    )
    started_s = booted_s + float(fields[19]) / os.sysconf("SC_CLK_TCK")
    return fields[0] not in ("Z", "X") and started_s <= spoke_s + _CLOCK_SLACK_S


def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()[:8]
