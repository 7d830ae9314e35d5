"""What must be true of Dagster's instance after each event: no run hangs, no slot is held."""

from collections.abc import Iterator

import dagster as dg

from assets.factory import DEVICE_POOL
from benchmarks.chaos.world import World
from pipelines.reaper import reap

_AT_WORK = [
    dg.DagsterRunStatus.QUEUED, dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.STARTED,
    dg.DagsterRunStatus.CANCELING,
]  # fmt: skip


def hanging(world: World) -> Iterator[str]:
    """What is wrong after the sensor `stale_run_reaper` had its tick."""
    with dg.DagsterInstance.from_config(str(world.instance)) as instance:
        reap(instance, quiet_s=0.0)
        started = dg.RunsFilter(statuses=[dg.DagsterRunStatus.STARTED, dg.DagsterRunStatus.CANCELING])
        yield from (f"run {run.run_id[:8]} is still {run.status.value}" for run in instance.get_runs(started))
        slots = instance.event_log_storage.get_concurrency_info(DEVICE_POOL)
        if slots.active_slot_count or slots.pending_step_count:
            yield f"pool {DEVICE_POOL}: {slots.active_slot_count} slots held, {slots.pending_step_count} wait"


def newest_run(world: World) -> tuple[str, str]:
    """Id and status of the newest run; empty if there is none."""
    with dg.DagsterInstance.from_config(str(world.instance)) as instance:
        runs = instance.get_runs(limit=1)
        return (runs[0].run_id, runs[0].status.value) if runs else ("", "")


def waits_or_runs(world: World) -> bool:
    """Whether any run waits or is at work."""
    with dg.DagsterInstance.from_config(str(world.instance)) as instance:
        return bool(instance.get_runs(dg.RunsFilter(statuses=_AT_WORK), limit=1))
