"""Drives on which nothing was tuned: other demo streets, with dense traffic or a sensor at rest.

``python -m benchmarks.tables.other_drives`` writes those of SCENES (default: all) that are not there yet,
measures them by Dagster's job ``benchmark`` with RECIPE (default: quick) and SEED (default: 0), and brings
the results up to date. No threshold was chosen on any of these streets, and none may be.
"""

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.common.documents import ROOT
from benchmarks.run import execute_benchmark
from benchmarks.tables.results_table import write
from benchmarks.tables.targets import OTHER
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.demo.motion import EgoSpeed
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.stages.runner.run import say_on_stderr

_SIZE = replace(DemoSize.full(), cameras=("image_00",), fisheye_side=0)
_TEST_FRAMES = [5, 13, 21, 29]
_STANDING, _WALKING_PACE = EgoSpeed(speeds_m_s=(0.0,)), EgoSpeed(speeds_m_s=(0.7,))
_STOP_AND_GO = EgoSpeed(times_s=(0.0, 1.2, 2.0, 3.2), speeds_m_s=(6.0, 0.0, 0.0, 5.0))


@dataclass(frozen=True, slots=True)
class OtherDrive:
    """What makes one of these drives different from the demo."""

    seed: int
    """Of its street and its noise; the demo's is 0."""
    traffic: int
    """Cars beside the demo's own."""
    speed: EgoSpeed | None
    """None: the demo's 9 m/s."""


OTHER_DRIVES = {
    f"{OTHER}street": OtherDrive(101, 0, None),
    f"{OTHER}traffic": OtherDrive(102, 12, None),
    f"{OTHER}crawling": OtherDrive(103, 8, _WALKING_PACE),
    f"{OTHER}standing": OtherDrive(104, 12, _STANDING),
    f"{OTHER}stop_and_go": OtherDrive(105, 8, _STOP_AND_GO),
}
"""Scene to drive."""


def write_drives(folder: Path, names: Iterable[str], size: DemoSize = _SIZE) -> Path:
    """Write the drives that are not there yet, and a catalogue of them all; returns the catalogue's path."""
    test_frames = [frame for frame in _TEST_FRAMES if frame < size.frames]
    entries = []
    for name in names:
        drive, root = OTHER_DRIVES[name], folder / name
        if not root.is_dir():
            say_on_stderr(f"[{name}] writing the drive")
            write_demo(root, size=size, seed=drive.seed, speed=drive.speed, traffic=drive.traffic)
        entries.append(
            f'[[scene]]\nname = "{name}"\nroot = "{name}"\nsequence = "{DEMO_SEQUENCE}"\nfirst_frame = 0\n'
            f"last_frame = {size.frames - 1}\ntest_frames = {test_frames}\nsweep_period_s = 0.1\n"
        )
    path = folder / "other_drives.toml"
    path.write_text("\n".join(entries))
    return path


def main() -> int:
    """Exit code of Dagster's run; what it finished is written all the same."""
    home = home_from_environment(os.environ)
    names = os.environ.get("SCENES", "").split() or list(OTHER_DRIVES)
    unknown = sorted(set(names) - set(OTHER_DRIVES))
    if unknown:
        print(f"no such drives: {', '.join(unknown)}; there are {', '.join(OTHER_DRIVES)}", file=sys.stderr)
        return 2
    catalogue = write_drives(home / "drives", names)
    chosen = {
        "NVSF_HOME": str(home), "NVSF_SCENES": str(catalogue), "SCENES": " ".join(names),
        "RECIPE": os.environ.get("RECIPE") or "quick",
    }  # fmt: skip
    worst = execute_benchmark(chosen)
    print(write(home, ROOT))
    return worst


if __name__ == "__main__":
    sys.exit(main())
