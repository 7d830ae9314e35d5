"""Where steps run: NVSF_EXECUTOR = in_process | multiprocess (default) | ray | k8s."""

import os

import dagster as dg

from nvsf_core.errors import RecipeError

_LOCAL_STEPS = 2
"""Steps at once on one machine: training is serial by the lease, other stages fill the gaps."""


def executor_from_environment() -> dg.ExecutorDefinition:
    """The executor that NVSF_EXECUTOR names.

    Raises:
        RecipeError: It names none of the four.
    """
    # Two scenes share the cores. By default OpenMP's threads spin while they wait, and take from the other
    # scene what they do not use: measured beside a busy core, a training step then takes twice as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    name = os.environ.get("NVSF_EXECUTOR") or "multiprocess"
    if name == "in_process":
        return dg.in_process_executor
    if name == "multiprocess":
        # forkserver with everything imported once: spawn would import torch anew for every step.
        start = {"forkserver": {"preload_modules": ["pipelines.definitions"]}}
        return dg.multiprocess_executor.configured({"max_concurrent": _LOCAL_STEPS, "start_method": start})
    # The other two are extras (`pip install -e .[ray]`, `.[k8s]`): imported only where asked for.
    if name == "ray":
        from dagster_ray import ray_executor

        return ray_executor
    if name == "k8s":
        from dagster_k8s import k8s_job_executor

        return k8s_job_executor
    raise RecipeError(f"NVSF_EXECUTOR={name!r}: expected in_process, multiprocess, ray or k8s")
