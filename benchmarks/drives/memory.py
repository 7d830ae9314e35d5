"""Peak memory of long drives: ``python -m benchmarks.drives.memory [FRAMES ...]`` (default 32 400).

Writes a demo drive of so many frames, then, each in a process of its own, reads it into the stages up to
`undistorted` in parts of 32 frames that share 8, runs the stage `evidence` of all parts, converts it by
`nvsf import`, and prints the highest resident memory of each. What grows with the drive would show.
"""

import resource
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

PART, OVERLAP = 32, 8
STAGES = ("frames", "sweeps", "pano", "undistorted")


def _run(stages: tuple[str, ...], root: Path, frames: int) -> None:
    from nvsf_core.drives.cuts import cut_scene
    from nvsf_core.stages import plan_run, run_named_stage

    for part in cut_scene(_entry(root, frames)):
        run = plan_run(part, root.parent / "home", recipe="smoke")
        for stage in stages:
            run_named_stage(stage, run, lambda line: None)


def _import(root: Path, frames: int) -> None:
    from dataclasses import replace

    from nvsf_core.stages.imports.convert import import_drive

    whole = replace(_entry(root, frames), cut_frames=None)
    import_drive(whole, root.parent / "plain", progress=lambda line: None)


def _entry(root: Path, frames: int):
    from nvsf_core.demo.drive import DEMO_SEQUENCE
    from nvsf_core.drives.entries import SceneEntry

    return SceneEntry(
        name="long", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=frames - 1,
        test_frames=tuple(range(5, frames - 1, 10)), sweep_period_s=0.1, cut_frames=PART,
        overlap_frames=OVERLAP,
    )  # fmt: skip


def _write(root: Path, frames: int) -> None:
    from nvsf_core.demo.drive import DemoSize, write_demo

    size = DemoSize(
        frames=frames, lasers=tuple(range(0, 64, 4)), firings=300, cameras=("image_00",), width=96, height=48,
        fisheye_side=0,
    )  # fmt: skip
    write_demo(root, size=size)


WAYS = {
    "ingest": partial(_run, STAGES),
    "evidence": partial(_run, ("evidence",)),
    "import": _import,
    "write": _write,
}


def peak_mb(way: str, root: Path, frames: int) -> float:
    """Highest resident memory of a process that does this, in MB."""
    command = [sys.executable, "-m", "benchmarks.drives.memory", f"--{way}", str(root), str(frames)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return float(done.stdout.split()[-1]) / 1024.0


def main(words: list[str]) -> None:
    """Do one way in this process and print its peak in kB, or measure all ways in processes of their own."""
    if words and words[0].startswith("--"):
        WAYS[words[0][2:]](Path(words[1]), int(words[2]))
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return
    print("| frames | ingested in parts of 32, peak MB | evidence of all parts | imported |")
    print("| --- | --- | --- | --- |")
    for frames in [int(word) for word in words] or [32, 400]:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "drive"
            peak_mb("write", root, frames)
            peaks_mb = [peak_mb(way, root, frames) for way in ("ingest", "evidence", "import")]
            print(f"| {frames} | {' | '.join(f'{one:.0f}' for one in peaks_mb)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
