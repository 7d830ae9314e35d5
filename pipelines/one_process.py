"""Dagster's executor of all steps in one process, which Ctrl-C ends.

Dagster tries an interrupted step again if its policy allows retries, as for a process that was killed. Where
there is one process, a step that asks for another try was interrupted: the process would not be here else,
and errors of a stage ask for none.
"""

from collections.abc import Iterator
from typing import Any

import dagster as dg
from dagster._core.execution.retries import RetryMode
from dagster._core.executor.in_process import InProcessExecutor

from pipelines.job_process import INTERRUPTED
from pipelines.reaper import say_which_host_runs_it


class OneProcess(InProcessExecutor):
    """All steps in the process of the run."""

    def execute(self, plan_context: Any, execution_plan: Any) -> Iterator[Any]:
        """Execute the steps; an interrupted one ends the run."""
        say_which_host_runs_it(plan_context.instance, plan_context.run_id)
        steps = super().execute(plan_context, execution_plan)
        try:
            for event in steps:
                yield event
                if event.is_step_up_for_retry:
                    raise dg.DagsterExecutionInterruptedError
        except (KeyboardInterrupt, dg.DagsterExecutionInterruptedError):
            steps.close()  # while it is open, what is said goes to the steps' own log
            plan_context.log.warning(INTERRUPTED)
            raise


@dg.executor(name="in_process")
def one_process(_: dg.InitExecutorContext) -> OneProcess:
    """Executor of all steps in the process of the run."""
    return OneProcess(retries=RetryMode.ENABLED)
