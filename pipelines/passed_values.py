"""What the steps of a run pass on: JSON documents below the home, which all machines of a run share.

Dagster's own way is pickles in $DAGSTER_HOME/storage. On Kubernetes that is a disk of each pod alone; and
nothing below a home may be unpickled (docs/safety.md).
"""

import contextlib
import os
import shutil
import time
from pathlib import Path
from typing import Any

import dagster as dg

from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.stores.documents import read_document, write_document

RUNS = ".runs"
"""Folder below a home of what runs passed on, a folder a run; no scene can have that name."""
_KEPT_S = 30 * 86_400.0
"""How long a run's folder stays after its last step: so long it can go on from where it failed."""
_VALUE = "value"


class PassedValues(dg.ConfigurableIOManager):
    """Keeps what JSON can say, as `<home>/.runs/<run>/<step>/<output>.json`."""

    def handle_output(self, context: dg.OutputContext, obj: Any) -> None:
        """Write a step's output."""
        path = _path(context)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_document(path, {_VALUE: obj})

    def load_input(self, context: dg.InputContext) -> Any:
        """Read what an earlier step wrote, on whichever machine."""
        if context.upstream_output is None:
            raise dg.Failure(f"expected {context.name} from an earlier step, found no step that makes it")
        return read_document(_path(context.upstream_output))[_VALUE]


def _path(output: dg.OutputContext) -> Path:
    *folders, name = output.get_identifier()
    return _runs().joinpath(*folders, f"{name}.json")


def _runs() -> Path:
    return home_from_environment(os.environ) / RUNS


def remove_old_values() -> None:
    """Remove what runs passed on whose last step ended more than a month ago."""
    for run in _runs().glob("*"):
        with contextlib.suppress(OSError):  # another run, which begins now too, has removed it
            # Each step that ends adds a folder.
            if time.time() - run.lstat().st_mtime > _KEPT_S:
                shutil.rmtree(run)
