"""What chaos happens to: a drive, a home on a small disk of its own, and the commands of a user."""

import contextlib
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.chaos.processes import Forked, Running
from benchmarks.common.documents import ROOT
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.drives.catalogue import load_catalogue
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.stages import STAGES, SceneRun, Stage, plan_run, run_scene
from nvsf_core.stages.flow import WORK_MODULES

SCENE = "tiny"
DISK_MB = 2500
"""Of the disk that the home lies on: 500 MB are kept free, and each event trains another seed."""
SHORT_DISK_MB = 900
"""The same in the short form, which trains nothing and may run where there is little memory."""
_PREPARED = 5
"""Stages of the short form: up to the evidence."""
LONGEST_RUN_S = 400.0
"""A run of the smallest drive takes half a minute; beside other work ten times as long."""
_CATALOGUE = f"""
[[scene]]
name = "{SCENE}"
root = "drive"
sequence = "{DEMO_SEQUENCE}"
first_frame = 0
last_frame = 3
test_frames = [2]
recipe = "smoke"

[[view]]
name = "shift_1m"
shift_m = [0.0, 1.0, 0.0]
frames = [1]
"""
_OURS = ("NVSF_", "DAGSTER_")


@dataclass(slots=True)
class World:
    """Folders, and how runs are started in them."""

    folder: Path
    has_disk: bool
    """Whether the home lies on a disk of its own, which may be filled and made read-only."""
    bare: bool = False
    """Whether runs are of the library alone, without Dagster: for the short form."""
    seed: int = 0
    """Of the latest run: each event asks for a training of its own."""
    runs: int = 0
    pristine: dict[str, bytes] = field(default_factory=dict)
    """File of the drive to its bytes as they were recorded."""

    @property
    def home(self) -> Path:
        """NVSF_HOME."""
        return self.folder / "disk" / "home"

    @property
    def instance(self) -> Path:
        """DAGSTER_HOME, where `make` has it."""
        return self.home / "dagster"

    @property
    def drive(self) -> DriveLayout:
        """The recorded drive."""
        return DriveLayout(self.folder / "drive", DEMO_SEQUENCE)

    def environment(self, **more: str) -> dict[str, str]:
        """Of a user's shell."""
        own = {k: v for k, v in os.environ.items() if not k.startswith(_OURS)}
        return own | {
            "NVSF_HOME": str(self.home), "DAGSTER_HOME": str(self.instance), "NVSF_THREADS": "1",
            "NVSF_SCENES": str(self.folder / "scenes.toml"), "SEED": str(self.seed), "SCENES": SCENE,
            "DAGSTER_MODULE_NAME": "pipelines.definitions", "DAGSTER_DISABLE_TELEMETRY": "1",
            "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore", "NVSF_EXECUTOR": "in_process",
            **more,
        }  # fmt: skip

    def start(self, prefix: tuple[str, ...] = (), **more: str) -> Running:
        """Start what `make train` starts, of the seed that is asked for."""
        if self.bare:
            self.runs += 1
            log = self.folder / f"run-{self.runs}.txt"
            return Running(Forked(self._prepare, log, self.environment(**more)), log)
        command = ["-m", "dagster", "job", "execute", "-j", "train_all_scenes"]
        return self.launch([*prefix, sys.executable, *command], "run", **more)

    def _prepare(self) -> None:
        """A run of the short form: what needs no training, by the library alone."""
        run_scene(SCENE, stages=self.stages)

    @property
    def stages(self) -> tuple[Stage, ...]:
        """What a run makes."""
        return STAGES[:_PREPARED] if self.bare else STAGES

    def provoke(self) -> None:
        """See to it that the next run has something to make."""
        if not self.bare:
            self.seed += 1
            return
        for stage in self.stages[1:]:
            shutil.rmtree(self.plan().store.path(stage.name), ignore_errors=True)

    def launch(self, command: list[str], name: str, **more: str) -> Running:
        """Start any command; its words are kept in a file that `name` begins."""
        self.runs += 1
        return Running.start(command, self.folder / f"{name}-{self.runs}.txt", self.environment(**more))

    def plan(self) -> SceneRun:
        """The latest run, as the library plans it."""
        (entry,) = load_catalogue([self.folder / "scenes.toml"], None)
        return plan_run(entry, self.home, recipe="smoke", seed=self.seed)

    def restore_drive(self) -> None:
        """Put the drive's bytes back as they were recorded."""
        for name, content in self.pristine.items():
            path = self.folder / "drive" / name
            if not path.is_file() or path.read_bytes() != content:
                path.write_bytes(content)


@contextlib.contextmanager
def made_world(folder: Path, *, bare: bool = False) -> Iterator[World]:
    """Write the drive and the catalogue, and mount a disk for the home where this process may."""
    if bare:  # its runs are forked from this process, and load no library again
        for name in WORK_MODULES:
            importlib.import_module(name)
    write_demo(folder / "drive", size=DemoSize.tiny())
    (folder / "scenes.toml").write_text(_CATALOGUE)
    (folder / "disk").mkdir()
    has_disk = os.geteuid() == 0 and _mounted(folder / "disk", SHORT_DISK_MB if bare else DISK_MB)
    try:
        world = World(folder, has_disk, bare)
        world.home.mkdir()
        files = (path for path in (folder / "drive").rglob("*") if path.is_file())
        world.pristine = {path.relative_to(folder / "drive").as_posix(): path.read_bytes() for path in files}
        if not bare:
            world.instance.mkdir()
            shutil.copy(ROOT / "pipelines" / "dagster.yaml", world.instance)
        yield world
    finally:
        if has_disk:
            subprocess.run(["umount", "--lazy", str(folder / "disk")], check=False)


def _mounted(place: Path, megabytes: int) -> bool:
    command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "nvsf-chaos", str(place)]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0
