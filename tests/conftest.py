"""What many tests need: a clean environment, the tiny drive, a process of its own, permissions that bind."""

import ctypes
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nvsf_core.kernels.threads import use_threads
from nvsf_core.thread_count import VARIABLE

REPO = Path(__file__).resolve().parents[1]
SHARED = REPO.parent / "shared"
"""Real drives, beside the checkout; tests that need them skip where they are absent."""
OURS = ("NVSF_", "DAGSTER_")
RUN_CHOICES = ("SCENES", "RECIPE", "SEED")
TINY_CATALOGUE = """
[[scene]]
name = "tiny"
root = "drive"
sequence = "2013_05_28_drive_9900_sync"
first_frame = 0
last_frame = 3
test_frames = [2]
recipe = "smoke"

[[scene]]
name = "absent"
root = "nowhere"
sequence = "2013_05_28_drive_0000_sync"
first_frame = 0
last_frame = 3
test_frames = [2]

[[view]]
name = "shift_1m"
scenes = ["tiny"]
shift_m = [0.0, 1.0, 0.0]
frames = [1]
"""

_CAPABILITIES_VERSION = 0x20080522
"""Of capset(2): one process by its id, then twice the effective, permitted and inheritable capabilities."""
_MAY_READ_ALL = 1 << 1 | 1 << 2
"""`CAP_DAC_OVERRIDE` and `CAP_DAC_READ_SEARCH`."""


def _bind_by_permissions() -> None:
    """Take root's right to read all files from this thread, and from all that it starts."""
    header, sets = (ctypes.c_uint32 * 2)(_CAPABILITIES_VERSION, 0), (ctypes.c_uint32 * 6)()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.capget(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capget")
    for place in (0, 1):
        sets[place] &= ~_MAY_READ_ALL
    if libc.capset(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capset")


# Else tests of files that may not be read would skip. In a checkout of somebody else root could not write.
if os.geteuid() == 0 == REPO.stat().st_uid and sys.platform == "linux":
    _bind_by_permissions()


def clean_environment() -> dict[str, str]:
    """The environment without what the user's shell says of this project."""
    return {k: v for k, v in os.environ.items() if not k.startswith(OURS) and k not in RUN_CHOICES}


@pytest.fixture(autouse=True)
def _no_choices_of_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in set(os.environ) - set(clean_environment()):
        if name != "DAGSTER_DISABLE_TELEMETRY":
            monkeypatch.delenv(name)
    monkeypatch.setenv("DAGSTER_DISABLE_TELEMETRY", "1")
    monkeypatch.setenv(VARIABLE, "1")  # two workers share two cores
    use_threads()


@pytest.fixture(scope="session")
def repo() -> Path:
    return REPO


@pytest.fixture(scope="session")
def tiny_catalogue(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalogue with the scene `tiny` (4 frames, 8 lasers, one small camera) and one without data."""
    from nvsf_core.demo.drive import DemoSize, write_demo

    folder = tmp_path_factory.mktemp("tiny")
    write_demo(folder / "drive", size=DemoSize.tiny())
    (folder / "scenes.toml").write_text(TINY_CATALOGUE)
    return folder / "scenes.toml"


@pytest.fixture(scope="module")
def without_lpips_and_mesh() -> Iterator[None]:
    """They take most of a tiny scene's time; a user without LPIPS's weights and open3d has none either."""
    from nvsf_core.errors import MissingLibraryError
    from nvsf_core.stages import mesh, scene_metrics

    def missing(*_: object, **__: object) -> None:
        raise MissingLibraryError("left out by this test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_metrics, "load_lpips", lambda: None)
        patch.setattr(mesh, "poisson_mesh", missing)
        yield


@pytest.fixture(scope="session")
def run_process() -> Iterator[Callable[..., subprocess.CompletedProcess[str]]]:
    """Run a command in the repository, with the given variables and none of the user's shell."""

    def run(*command: str, timeout_s: float = 200.0, **variables: str) -> subprocess.CompletedProcess[str]:
        environment = clean_environment() | {"DAGSTER_DISABLE_TELEMETRY": "1", VARIABLE: "1", **variables}
        environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
        return subprocess.run(
            command, cwd=REPO, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
        )

    yield run
