"""Shows runs that a terminal started under their job and on the timeline of the UI.

Dagster's command line starts a run without saying of which code location its job is, and the UI lists such a
run under Runs alone. The run itself adds it, as `dagster run migrate-repository` does for older runs.
"""

import os
import sys

import dagster as dg
from dagster._core.remote_origin import (
    ManagedGrpcPythonEnvCodeLocationOrigin,
    RemoteJobOrigin,
    RemoteRepositoryOrigin,
)
from dagster._core.types.loadable_target_origin import LoadableTargetOrigin

LOCATION, MODULE = "nvsf", "pipelines.definitions"
"""Of the code location, as workspace.yaml and pyproject.toml name it."""
TERMINAL_TAG = "nvsf/started_by"
"""Tag of a run that a terminal started, not the daemon or the UI."""
_REPOSITORY = "__repository__"
_REPOSITORY_TAG = ".dagster/repository"


def say_whose_run_it_is(instance: dg.DagsterInstance, run_id: str) -> None:
    """Give a terminal's run the origin of its job, and a tag that says who started it; others have one."""
    run = None if instance.is_ephemeral else instance.get_run_by_id(run_id)
    if run is None or run.remote_job_origin is not None:
        return
    # The tags first: what replaces the origin only changes the row of a tag that is there.
    instance.add_run_tags(run_id, {_REPOSITORY_TAG: f"{_REPOSITORY}@{LOCATION}", TERMINAL_TAG: "terminal"})
    run = instance.get_run_by_id(run_id) or run
    target = LoadableTargetOrigin(
        executable_path=sys.executable, module_name=MODULE, working_directory=os.getcwd()
    )
    location = ManagedGrpcPythonEnvCodeLocationOrigin(target, location_name=LOCATION)
    origin = RemoteJobOrigin(RemoteRepositoryOrigin(location, _REPOSITORY), run.job_name)
    instance.run_storage.replace_job_origin(run, origin)
