"""Dagster executors, chosen by NVSF_EXECUTOR = in_process | multiprocess (default) | ray | k8s."""

import contextlib
import os
from collections.abc import Iterator

import dagster as dg

from nvsf_core.errors import MissingLibraryError, RecipeError
from nvsf_core.thread_count import thread_count
from pipelines.one_process import one_process
from pipelines.step_processes import step_processes

_THREADS_A_STEP = 4
"""With fewer, a second step at once gains nothing: a step uses all threads itself."""
_CORES_A_STEP = 1.0
"""What Ray keeps free for a step; without it Ray starts all steps on its head."""
_SENT = ("SCENES", "RECIPE", "SEED", "DAGSTER_HOME", "DAGSTER_MODULE_NAME", "PYTHONPATH")
_MOST_STEPS = 4
"""Most parallel steps: each takes about 1.5 GB of memory."""


def executor_from_environment() -> dg.ExecutorDefinition:
    """The executor that NVSF_EXECUTOR names.

    Raises:
        RecipeError: NVSF_EXECUTOR has another value.
        MissingLibraryError: The extra of that executor is not installed.
    """
    name = os.environ.get("NVSF_EXECUTOR") or "multiprocess"
    if name == "in_process":
        return one_process
    if name == "multiprocess":
        return step_processes(_local_steps())
    # The other two are extras (`pip install -e .[ray]`, `.[k8s]`), imported only if chosen.
    if name == "ray":
        with _extra(name):
            from dagster_ray import ray_executor
        return ray_executor.configured({"ray": {"num_cpus": _CORES_A_STEP, "env_vars": _sent_variables()}})
    if name == "k8s":
        with _extra(name):
            from dagster_k8s import k8s_job_executor
        return k8s_job_executor
    raise RecipeError(f"NVSF_EXECUTOR={name!r}: expected in_process, multiprocess, ray or k8s")


def _sent_variables() -> list[str]:
    """Variables of this process that a step on another machine must have, too."""
    return sorted(name for name in os.environ if name.startswith("NVSF_") or name in _SENT)


@contextlib.contextmanager
def _extra(name: str) -> Iterator[None]:
    """Context of the import of an extra's package.

    Raises:
        MissingLibraryError: The extra is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise MissingLibraryError(
            f"NVSF_EXECUTOR={name} needs packages of an extra that is not installed ({error}): "
            f"pip install -e '.[{name}]', or unset NVSF_EXECUTOR to run on this machine"
        ) from error


def timing_executor() -> dg.ExecutorDefinition:
    """An executor for measurements: one step at a time, in its own process, so time and memory are exact."""
    return step_processes(1)


def _local_steps() -> int:
    """Number of parallel steps; each may use all of NVSF_THREADS where the others wait."""
    return max(1, min(_MOST_STEPS, thread_count() // _THREADS_A_STEP))
