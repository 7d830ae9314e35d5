"""Memory of a scene, and how it grows with frames, metres and cameras: part of `docs/scaling.md`.

``python -m benchmarks.drives.scene_memory`` writes two demo drives, of which one is driven at a quarter of
the speed, cuts scenes of different lengths and cameras from them, and takes each through the stages up to
`field` with the recipe `quick`. `evidence` and `field` run in processes of their own, whose highest resident
memory is noted. A linear fit says what a frame, an image and a metre cost.
"""

import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import documents
from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.demo.motion import FRAME_PERIOD_S, EgoSpeed
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.stages import plan_run, run_named_stage

_CAMERAS = ("image_00", "image_01", "image_02")
_SPEEDS_M_S = (9.0, 2.25)
_MEASURED = ("evidence", "field")
_BEFORE = {"evidence": ("frames", "sweeps", "pano", "undistorted"), "field": ()}
_KIB_A_MB = 1e6 / 1024


@dataclass(frozen=True, slots=True)
class Variant:
    """A scene cut from one of the drives."""

    frames: int
    """Number of frames."""
    cameras: int
    """Number of cameras."""
    speed_m_s: float
    """Of the recording car."""

    @property
    def metres(self) -> float:
        """Length of the recorded path."""
        return (self.frames - 1) * FRAME_PERIOD_S * self.speed_m_s


VARIANTS = (
    Variant(16, 3, 9.0), Variant(32, 3, 9.0), Variant(32, 1, 9.0), Variant(64, 1, 9.0), Variant(32, 3, 2.25),
)  # fmt: skip


def main(words: list[str]) -> None:
    """Run one stage in this process and print its peak in KiB, or measure all variants, store and write."""
    if words:
        stage, drives, number = words[0], Path(words[1]), int(words[2])
        _run(stage, drives, VARIANTS[number])
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        drives = Path(folder)
        for speed in _SPEEDS_M_S:
            size = DemoSize(
                frames=max(one.frames for one in VARIANTS), lasers=tuple(range(64)), firings=2100,
                cameras=_CAMERAS[:2], width=704, height=188, fisheye_side=350,
            )  # fmt: skip
            write_demo(_root(drives, speed), size=size, speed=EgoSpeed(speeds_m_s=(speed,)))
        for number, one in enumerate(VARIANTS):
            peaks = {f"{stage}_mb": _peak_mb(stage, drives, number) for stage in _MEASURED}
            rows.append({"frames": one.frames, "cameras": one.cameras, "metres": one.metres, **peaks})
            print(rows[-1], flush=True)
    documents.write_measured(documents.RESULTS_DIR / "scene_memory.json", {"rows": rows})
    head = documents.measured_on()
    documents.write_between(documents.DOCS / "scaling.md", "memory", head + document(rows))


def document(rows: list[dict[str, Any]]) -> str:
    """The table of all variants, and the fit in words."""
    head = ["frames", "cameras", "metres", "`evidence` MB", "`field` MB", "fit of `field` MB"]
    costs_mb = fit(rows)
    base_mb, frame_mb, image_mb, metre_mb = costs_mb
    lines = [
        [
            row["frames"], row["cameras"], f"{row['metres']:.0f}", f"{row['evidence_mb']:,.0f}",
            f"{row['field_mb']:,.0f}",
            f"{np.dot(costs_mb, _sizes(row)):,.0f}",
        ]
        for row in rows
    ]  # fmt: skip
    words = (
        f"\n`field` takes about {base_mb:,.0f} MB, and {frame_mb:.1f} MB more for each frame of the LiDAR, "
        f"{image_mb:.1f} for each image of some 0.13 megapixels, {metre_mb:.1f} for each metre of "
        "the path: least squares over the rows.\n"
    )
    return documents.markdown_table(head, lines, "|" + " ---: |" * len(head)) + words


def fit(rows: list[dict[str, Any]]) -> list[float]:
    """Least squares of `field`: MB of nothing, and MB for each frame, image and metre."""
    measured_mb = [row["field_mb"] for row in rows]
    return np.linalg.lstsq([_sizes(row) for row in rows], measured_mb, rcond=None)[0].tolist()


def _sizes(row: dict[str, Any]) -> list[float]:
    return [1.0, row["frames"], row["frames"] * row["cameras"], row["metres"]]


def _root(drives: Path, speed_m_s: float) -> Path:
    return drives / f"drive_{speed_m_s:g}"


def _peak_mb(stage: str, drives: Path, number: int) -> float:
    command = [sys.executable, "-m", "benchmarks.drives.scene_memory", stage, str(drives), str(number)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return float(done.stdout.split()[-1]) / _KIB_A_MB


def _run(stage: str, drives: Path, one: Variant) -> None:
    scene = SceneEntry(
        name=f"scene_{one.frames}_{one.cameras}_{one.speed_m_s:g}".replace(".", "_"),
        root=_root(drives, one.speed_m_s), sequence=DEMO_SEQUENCE, first_frame=0, last_frame=one.frames - 1,
        test_frames=tuple(range(5, one.frames, 8)), sweep_period_s=FRAME_PERIOD_S,
        cameras=_CAMERAS[: one.cameras],
    )  # fmt: skip
    run = plan_run(scene, drives / "home", recipe="quick")
    for name in (*_BEFORE[stage], stage):
        run_named_stage(name, run, lambda line: None)


if __name__ == "__main__":
    main(sys.argv[1:])
