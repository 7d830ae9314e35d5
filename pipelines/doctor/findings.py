"""Examine what a machine lacks, and what cannot run without it."""

import importlib.util
import os
import platform
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nvsf_core.clouds.open3d_room import load_open3d
from nvsf_core.drives.catalogue import catalogue_from_environment, home_from_environment
from nvsf_core.drives.drive import has_data
from nvsf_core.errors import NvsfError
from nvsf_core.metrics.lpips_file import WEIGHTS_NAME, WEIGHTS_VARIABLE, find_weights
from nvsf_core.stores.removal import KEEP_VARIABLE, number_kept
from nvsf_core.stores.scene_store import require_home
from nvsf_core.thread_count import thread_count
from pipelines.doctor.instance import examine_instance
from pipelines.doctor.locks import examine_locks
from pipelines.executors import executor_from_environment
from pipelines.switch import AUTOMATE_VARIABLE, is_on, quiet_s

_FREE_GB = 5.0
"""Free space that is asked for; one scene takes about half of it."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one examination."""

    subject: str
    is_fine: bool
    words: str
    is_needed: bool = False
    """Whether nothing runs without it."""


def examine(environ: Mapping[str, str]) -> list[Finding]:
    """Examine everything; nothing is written but a temporary folder."""
    return [
        _machine(), _threads(), _kernels(), _gpu(), _home(environ), _locks(environ), _catalogue(environ),
        _versions(environ), _automation(environ), _open3d(), _lpips(), _executors(),
        Finding("Dagster instance", *examine_instance(environ)),
    ]  # fmt: skip


def _machine() -> Finding:
    words = f"{os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    if platform.system() != "Linux":
        return Finding("machine", False, f"{words}; only Linux is tested: locks may not hold elsewhere")
    return Finding("machine", True, words)


def _threads() -> Finding:
    from nvsf_core.kernels.threads import kernels_bear_threads

    try:
        thread_count()
    except NvsfError as error:
        return Finding("threads", False, str(error), is_needed=True)
    if kernels_bear_threads():
        return Finding("threads", True, "parts of a step and views run at once")
    words = "no OpenMP: parts of a step and views run one after the other; apt-get install libgomp1"
    return Finding("threads", False, words)


def _kernels() -> Finding:
    from nvsf_core.kernels.cache import IS_KEPT

    if IS_KEPT:
        return Finding("kernels", True, f"compiled ones are kept in {os.environ['NUMBA_CACHE_DIR']}")
    words = "no folder to keep compiled ones in: each process compiles them anew, for up to a minute; make "
    return Finding("kernels", False, f"{words}~/.cache writable, or a folder that NUMBA_CACHE_DIR names")


def _gpu() -> Finding:
    import torch

    if torch.cuda.is_available():
        return Finding("GPU", True, f"{torch.cuda.get_device_name()}, torch {torch.__version__}")
    words = f"none that torch {torch.__version__} can use; lean and quick need none, paper takes days without"
    return Finding("GPU", False, words)


def _home(environ: Mapping[str, str]) -> Finding:
    place = home_from_environment(environ)
    try:
        place = require_home(place)
    except NvsfError as error:
        return Finding("NVSF_HOME", False, str(error), is_needed=True)
    free_gb = shutil.disk_usage(_existing(place)).free / 1e9
    words = f"{place}, {free_gb:.0f} GB free"
    if free_gb < _FREE_GB:
        return Finding("NVSF_HOME", False, f"{words}; {_FREE_GB:.0f} GB are needed for a few scenes")
    return Finding("NVSF_HOME", True, words)


def _locks(environ: Mapping[str, str]) -> Finding:
    return Finding("locks", *examine_locks(_existing(home_from_environment(environ))))


def _existing(place: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    # `Path.is_dir` raises below a folder that may not be entered.
    return next(folder for folder in (place.absolute(), *place.absolute().parents) if os.path.isdir(folder))


def _catalogue(environ: Mapping[str, str]) -> Finding:
    try:
        entries = catalogue_from_environment(environ)
    except NvsfError as error:
        return Finding("catalogue", False, str(error), is_needed=True)
    there, faults = list[str](), list[str]()
    for entry in entries:
        try:
            there += [entry.name] if has_data(entry) else []
        except NvsfError as error:
            faults.append(str(error))
    words = f"{len(entries)} scenes, with data here: {', '.join(there) or 'none (nvsf demo writes its own)'}"
    return Finding("catalogue", not faults, "; ".join([words, *faults]))


def _versions(environ: Mapping[str, str]) -> Finding:
    try:
        number = number_kept(environ)
    except NvsfError as error:
        return Finding("data sets", False, str(error), is_needed=True)
    words = f"all versions are kept; {KEEP_VARIABLE} limits their number"
    if number is not None:
        words = f"the newest {number} versions of each view, recipe and seed are kept ({KEEP_VARIABLE})"
    return Finding("data sets", True, words)


def _automation(environ: Mapping[str, str]) -> Finding:
    try:
        follows = is_on(AUTOMATE_VARIABLE, environ)
        quiet_s(environ)
    except NvsfError as error:
        return Finding("automation", False, str(error), is_needed=True)
    words = f"off until it is switched on in the UI ({AUTOMATE_VARIABLE}=1: from the start)"
    return Finding(
        "automation", True, f"{AUTOMATE_VARIABLE} is on: drives train by themselves" if follows else words
    )


def _open3d() -> Finding:
    try:
        load_open3d()
    except NvsfError as error:
        cost = "Without it no mesh baseline, no registration check"
        return Finding("open3d", False, f"{error}. {cost}")
    return Finding("open3d", True, "the mesh baseline and the registration check run")


def _lpips() -> Finding:
    try:
        path: Path | None = find_weights()
    except NvsfError as error:
        return Finding("LPIPS weights", False, str(error))
    if path is None:
        words = (
            f"not found: make {WEIGHTS_NAME} with `nvsf weights` and set {WEIGHTS_VARIABLE}; else `not run`"
        )
        return Finding("LPIPS weights", False, words)
    return Finding("LPIPS weights", True, str(path))


def _executors() -> Finding:
    try:
        executor_from_environment()
    except NvsfError as error:
        return Finding("executors", False, str(error), is_needed=True)
    known = {"ray": "dagster_ray", "k8s": "dagster_k8s"}
    there = [name for name, module in known.items() if importlib.util.find_spec(module) is not None]
    words = f"in_process, multiprocess{''.join(', ' + name for name in there)}"
    return Finding("executors", True, f"{words}; pip install 'nvsf[ray]' or 'nvsf[k8s]' adds others")
