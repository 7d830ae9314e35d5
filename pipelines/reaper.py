"""`stale_run_reaper`: a sensor that marks runs as failed if their processes are gone.

A killed run (SIGKILL, power) stays STARTED for ever: it holds its pool slots and counts against
`max_concurrent_runs`. Dagster's run monitoring asks a launcher for the health of a run, and the default one
knows none. Every run says which machine it is on, also one of the UI's button, which is of no job of ours.
"""

import datetime
import os
import socket
import time
from pathlib import Path

import dagster as dg

HOST_TAG = "nvsf/host"
"""Tag of a run: `<host name>/<boot id>` of the machine of its processes."""
CLOCK_TAG = "nvsf/started_s"
"""Tag of a run: when its machine was started by the clock of then; one that was set since tells another."""
_LOCAL_EXECUTORS = ("", "in_process", "multiprocess")
_QUIET_S = 60.0
"""A run may have no process for a moment, for example while the next step starts."""
_CLOCK_SLACK_S = 2.0
"""Tolerance of process start times: the kernel gives the boot time in whole seconds."""
_MESSAGE = (
    "The run's processes are gone (killed, or the machine went down). Run it again: what was finished is "
    "skipped, and training resumes."
)


def host_tags() -> dict[str, str]:
    """Tags of a run that stays on this machine; none if the executor sends steps to other machines."""
    if os.environ.get("NVSF_EXECUTOR", "") not in _LOCAL_EXECUTORS:
        return {}
    return {HOST_TAG: f"{socket.gethostname()}/{_boot()}", CLOCK_TAG: f"{_machine_started_s():.0f}"}


def say_which_host_runs_it(instance: dg.DagsterInstance, run_id: str) -> None:
    """Tag a run that begins here; one that was launched again has the tags of where it ran before."""
    instance.add_run_tags(run_id, host_tags())


@dg.sensor(
    minimum_interval_seconds=60,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Marks runs as failed whose processes on this machine are gone, and frees their pool slots.",
)
def stale_run_reaper(context: dg.SensorEvaluationContext) -> dg.SkipReason:
    """Mark stale runs as failed; no run is requested."""
    reaped = reap(context.instance)
    return dg.SkipReason(f"marked as failed: {', '.join(reaped)}" if reaped else "no stale run")


def reap(instance: dg.DagsterInstance, quiet_s: float = _QUIET_S) -> list[str]:
    """Mark stale runs as failed.

    Args:
        instance: The Dagster instance.
        quiet_s: A run with an event in the last `quiet_s` seconds is not stale.

    Returns:
        Ids of the marked runs.
    """
    reaped = []
    for run in stale_runs(instance, quiet_s):
        instance.report_run_failed(run, _MESSAGE)
        storage = instance.event_log_storage
        if storage.supports_global_concurrency_limits:
            storage.free_concurrency_slots_for_run(run.run_id)
        reaped.append(run.run_id)
    return reaped


def stale_runs(instance: dg.DagsterInstance, quiet_s: float = _QUIET_S) -> list[dg.DagsterRun]:
    """Runs that are said to run, and whose processes on this machine are gone; and those that never began.

    A process that is killed between recording its run and beginning it leaves a run that nothing begins any
    more: the scene counts as being made.

    Args:
        instance: The Dagster instance.
        quiet_s: A run with an event in the last `quiet_s` seconds is not stale.
    """
    started = dg.RunsFilter(statuses=[dg.DagsterRunStatus.STARTED, dg.DagsterRunStatus.CANCELING])
    patience = datetime.timedelta(seconds=instance.run_monitoring_start_timeout_seconds)
    late = dg.RunsFilter(
        statuses=[dg.DagsterRunStatus.NOT_STARTED],
        created_before=datetime.datetime.now(datetime.UTC) - patience,
    )
    stale = [run for run in instance.get_runs(started) if _is_stale(instance, run, quiet_s)]
    return [*stale, *instance.get_runs(late)]


def _is_stale(instance: dg.DagsterInstance, run: dg.DagsterRun, quiet_s: float) -> bool:
    host, _, boot = run.tags.get(HOST_TAG, "").rpartition("/")
    if host != socket.gethostname():
        return False
    entries = instance.all_logs(run.run_id)
    # Of a clock that was set back, events may lie in the future for long.
    if abs(time.time() - max((entry.timestamp for entry in entries), default=0.0)) < quiet_s:
        return False
    if boot != _boot():
        return True
    spoke_s: dict[int, float] = {}
    for entry in entries:
        if entry.dagster_event is not None and entry.dagster_event.pid is not None:
            spoke_s[entry.dagster_event.pid] = entry.timestamp
    set_forward_s = _set_forward_s(run)
    return not any(_is_alive(pid, moment_s + set_forward_s) for pid, moment_s in spoke_s.items())


def _set_forward_s(run: dg.DagsterRun) -> float:
    """By how much the machine's clock was set forward since the run began; 0 if it was not."""
    told = run.tags.get(CLOCK_TAG, "")
    return max(0.0, _machine_started_s() - float(told)) if told.isdigit() else 0.0


def _machine_started_s() -> float:
    """When this machine was started, by its clock of now, in whole seconds."""
    lines = Path("/proc/stat").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("btime"))


def _is_alive(pid: int, spoke_s: float) -> bool:
    """Whether a process that logged at `spoke_s` still runs: not a zombie, nor a later process of that id."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False
    started_s = _machine_started_s() + float(fields[19]) / os.sysconf("SC_CLK_TCK")
    return fields[0] not in ("Z", "X") and started_s <= spoke_s + _CLOCK_SLACK_S


def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()[:8]
