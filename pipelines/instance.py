"""A new Dagster instance: its tables first, its configuration last and only where it has none.

``python -m pipelines.instance`` makes that of DAGSTER_HOME (default: in NVSF_HOME), as `make` does before its
first run.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.errors import NvsfError, StoreError
from nvsf_core.stages.runner.locks import file_lock
from nvsf_core.stages.runner.run import say_on_stderr
from nvsf_core.stores.writers import temporary_of

TEMPLATE = "dagster.yaml"
DAGSTER = (sys.executable, "-P", "-m", "dagster")
"""Dagster's command; without -P a module of the user's working folder would take the place of a package's."""
_LOCK = ".making.lock"
_MOST_WORDS = 400


def instance_place(environ: Mapping[str, str]) -> Path:
    """DAGSTER_HOME; by default the one that `make` and `nvsf` use, in the home."""
    return Path(environ.get("DAGSTER_HOME") or home_from_environment(environ) / "dagster").absolute()


def make_instance(place: Path) -> None:
    """Make the instance at `place`, unless it has a `dagster.yaml`, which is the user's from then on.

    Two processes that meet an empty folder would race for its tables: the second one waits for the first.

    Raises:
        StoreError: The disk refused, or Dagster could not make the tables.
    """
    if (place / TEMPLATE).is_file():
        return
    try:
        with file_lock(place / _LOCK, say_on_stderr, f"{place}, which another run makes"):
            if not (place / TEMPLATE).is_file():
                _make_tables(place)
                _copy_template(place / TEMPLATE)
    except OSError as error:
        raise StoreError(
            f"DAGSTER_HOME={place}: expected to make an instance there, found {error}; check space and "
            "rights, or name another folder"
        ) from error


def _make_tables(place: Path) -> None:
    # Without its configuration the instance would count this command for Dagster's makers.
    environment = os.environ | {"DAGSTER_HOME": str(place), "DAGSTER_DISABLE_TELEMETRY": "1"}
    done = subprocess.run(
        [*DAGSTER, "instance", "info"], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise StoreError(
            f"DAGSTER_HOME={place}: expected `dagster instance info` to make the instance's tables, found "
            f"exit status {done.returncode}: {done.stderr.strip()[-_MOST_WORDS:]}; name another folder, or "
            "remove it if it has no runs that you need"
        )


def _copy_template(target: Path) -> None:
    """Copy the template by one rename: who sees the file sees the whole, and that the tables are there."""
    new = temporary_of(target)
    with resources.as_file(resources.files("pipelines").joinpath(TEMPLATE)) as template:
        shutil.copyfile(template, new)
    new.replace(target)


if __name__ == "__main__":
    try:
        make_instance(instance_place(os.environ))
    except NvsfError as error:
        sys.exit(str(error))
