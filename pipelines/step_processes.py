"""Dagster's executor of steps in processes, which goes on where the process that starts them is killed.

A step is forked by a server (`multiprocessing`'s forkserver), which has imported everything once. Python
starts another server for the next step if this one is dead; where it dies while it starts a step, Python
raises EOFError or ConnectionError, which Dagster takes for the end of the run. Here that step is
asked for again.
"""

import multiprocessing
import sys
import time
from collections.abc import Iterator
from multiprocessing.context import ForkServerProcess
from typing import Any

import dagster as dg
from dagster._core.execution.retries import RetryMode
from dagster._core.executor.multiprocess import MultiprocessExecutor

from nvsf_core.errors import StageKilledError
from nvsf_core.stages.flow import WORK_MODULES
from pipelines.job_process import INTERRUPTED
from pipelines.reaper import say_which_host_runs_it

_PRELOADED = "pipelines.definitions"
_MOST_STARTS = 4
"""Of one step. Whatever kills one server after the other is not outlived by a further one."""
_PAUSE_S = 0.5
"""The kernel needs a moment to end a killed server; until then Python takes it for alive."""
_SERVER_DIED = "the process that starts the steps was killed (by hand, or out of memory) while it started"


class StepProcess(ForkServerProcess):
    """The process of a step, which is asked for again where its server is killed meanwhile."""

    starts = 0
    """How often the server was asked for it."""

    def start(self) -> None:
        """Start it.

        Where the dead server has started it after all, both wait for each other by the locks of outputs.

        Raises:
            StageKilledError: Four servers were killed.
        """
        while True:
            self.starts += 1
            try:
                return super().start()
            except (EOFError, ConnectionError) as error:
                if self.starts == _MOST_STARTS:
                    raise StageKilledError(
                        f"{_SERVER_DIED} {self.name}; so were the {_MOST_STARTS - 1} in its place. "
                        "Run again: what was finished is skipped, and training resumes. If it happens "
                        "again, free memory: the kernel's log (dmesg) names what it killed"
                    ) from error
                time.sleep(_PAUSE_S)


class StepProcesses(MultiprocessExecutor):
    """Each step in a process of its own."""

    def execute(self, plan_context: Any, execution_plan: Any) -> Iterator[Any]:
        """Execute the steps; says which of them had to be started again."""
        say_which_host_runs_it(plan_context.instance, plan_context.run_id)
        started: dict[str, StepProcess] = {}

        def process(*, args: tuple[Any, ...], **named: Any) -> StepProcess:
            key = args[1].step_key
            started[key] = StepProcess(args=args, name=f"the step {key}", **named)
            return started[key]

        context = multiprocessing.get_context("forkserver")
        context.Process = process
        try:
            for event in super().execute(plan_context, execution_plan):
                for key in [key for key, one in started.items() if one.pid is not None]:
                    if started.pop(key).starts > 1:
                        plan_context.log.warning(f"{_SERVER_DIED} the step {key}; another one started it")
                yield event
        except dg.DagsterExecutionInterruptedError:
            plan_context.log.warning(INTERRUPTED)
            raise
        finally:
            del context.Process


@dg.executor(
    name="multiprocess",
    config_schema={"max_concurrent": int},
    requirements=dg.multiple_process_executor_requirements(),
)
def _executor(context: dg.InitExecutorContext) -> StepProcesses:
    return StepProcesses(
        retries=RetryMode.ENABLED, max_concurrent=context.executor_config["max_concurrent"],
        start_method="forkserver", explicit_forkserver_preload=_preloaded(),
    )  # fmt: skip


def _preloaded() -> list[str]:
    """Modules that the server imports, so that no step has to.

    Besides the definitions those that the stages work with, which this process does not need itself, and
    those of Dagster that it has needed: it has opened the instance, whose storages take a second to import.
    """
    opened = [name for name in sys.modules if name.partition(".")[0].startswith("dagster")]
    return [_PRELOADED, *WORK_MODULES, *sorted(opened)]


def step_processes(most_steps: int) -> dg.ExecutorDefinition:
    """An executor of at most so many steps at once, each in a process that has everything imported."""
    return _executor.configured({"max_concurrent": most_steps})
