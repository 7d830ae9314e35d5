"""Examine a Dagster instance: its configuration, its daemon, and runs that hang."""

import time
from collections.abc import Iterator, Mapping

import dagster as dg

from pipelines.instance import TEMPLATE, instance_place
from pipelines.reaper import stale_runs

_BEAT_S = 120.0
"""A daemon says at least every half a minute that it lives."""
_SETTINGS = {
    "run_retries": "runs whose process died are not launched again",
    "run_monitoring": "runs that the daemon launched and that died stay STARTED",
    "freshness": "nothing says that a data set or the report is old",
}

_PATIENT_S = 600
_PATIENCE = (("run_monitoring", "start_timeout_seconds"), ("code_servers", "local_startup_timeout"))
"""Of three minutes each, unless the instance says otherwise; what is late is not tried again."""


def examine_instance(environ: Mapping[str, str]) -> tuple[bool, str]:
    """Whether the instance is as it should be, and what was found; nothing is written.

    An instance that does not exist yet is fine: the first run makes it.
    """
    place = instance_place(environ)
    try:
        if not (place / TEMPLATE).is_file():
            return True, (
                f"none at {place} yet; `make ui`, `nvsf train` and `python -m pipelines.instance` make it, "
                "the bare `dagster` does not"
            )
        if not (place / "history").is_dir():
            return True, f"{place}, without any run yet"
        with dg.DagsterInstance.from_config(str(place)) as instance:
            faults = list(_faults(instance))
            words = f"{place}, {instance.get_runs_count()} runs, {_daemon(instance)}"
    # Whatever is wrong with a configuration or a database, the doctor says it and goes on.
    except Exception as error:
        said = next(iter(str(error).splitlines()), "")  # a database adds its statement
        return False, f"{place} cannot be opened ({type(error).__name__}: {said:.200})"
    return not faults, f"{words}{''.join('; ' + fault for fault in faults)}"


def _faults(instance: dg.DagsterInstance) -> Iterator[str]:
    for name, cost in _SETTINGS.items():
        settings = instance.get_settings(name)
        if not (isinstance(settings, dict) and settings.get("enabled")):
            yield f"{TEMPLATE} lacks `{name}: enabled: true`: {cost}"
    pools = (instance.get_settings("concurrency") or {}).get("pools") or {}
    if not pools.get("default_limit"):
        yield f"{TEMPLATE} lacks `concurrency: pools: default_limit: 1`: what waits for a device is not shown"
    for name, key in _PATIENCE:
        if (instance.get_settings(name) or {}).get(key, 0) < _PATIENT_S:
            yield f"{TEMPLATE} lacks `{name}: {key}: {_PATIENT_S}`: a busy machine gives up a run that starts"
    stale = stale_runs(instance)
    if stale:
        named = ", ".join(run.run_id[:8] for run in stale)
        yield f"runs whose processes are gone: {named} (the sensor `stale_run_reaper` ends them)"


def _daemon(instance: dg.DagsterInstance) -> str:
    beats = instance.get_daemon_heartbeats().values()
    newest = max((beat.timestamp for beat in beats), default=0.0)
    return "its daemon runs" if time.time() - newest < _BEAT_S else "no daemon runs: nothing starts by itself"
