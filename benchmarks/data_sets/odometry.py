"""Whether scans of a data set carry an odometry as recorded ones do: KISS-ICP against the commanded poses.

``NVSF_SCENES=... SCENES=k360_street RECIPE=quick python -m benchmarks.data_sets.odometry`` (with the extra
`odometry`) writes all frames of a trained scene on the recorded path and a metre to its left, runs KISS-ICP
over both and over the recorded scans, and writes the errors of the steps into docs/data_sets.md. The target
is no more than a tenth worse than the recorded scans.

KISS-ICP keeps one point of each voxel, of a grid along the sensor's axes. Which ones is chance, and decides
over several millimetres of a step, so that one run a drive cannot tell two drives apart. Each drive is
therefore run twelve times in two ways: with the sensor's axes turned, which changes the voxels, and with the
points in another order, which changes the points that are kept. Neither changes what was measured.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.common.documents import DOCS, commit, markdown_table, write_between
from nvsf_core.clouds.odometry import odometry_path
from nvsf_core.drives.catalogue import SceneEntry, home_from_environment
from nvsf_core.metrics.trust.path_error import step_error_m
from nvsf_core.stages.render_view import render_view
from nvsf_core.stages.runner.host import machine
from nvsf_core.stages.runner.run import find_scene
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.documents import read_document
from nvsf_core.stores.scene_store import SceneStore

PAGE = DOCS / "data_sets.md"
TARGET = 1.1
_RUNS = 12
_QUARTER_RAD = np.pi / 2.0
"""Turned by so much, the grid of voxels is the same again."""
_PLACES = (("on the path", (0.0, 0.0, 0.0)), ("1 m to the left", (0.0, 1.0, 0.0)))


class Drive(NamedTuple):
    """Consecutive scans and the poses that they were recorded or rendered at."""

    scans: list[tuple[np.ndarray, np.ndarray]]
    """Of each its points (m, 3), metres, in the sensor's frame, and their times (m,) in sweeps."""
    poses: np.ndarray
    """(n, 4, 4)."""


def main() -> None:
    """Measure every scene, print the table, and write it into the page."""
    home, recipe = home_from_environment(os.environ), os.environ.get("RECIPE") or "quick"
    rows = []
    for name in (os.environ.get("SCENES") or "k360_street").split():
        scene = find_scene(name)
        drives = [("synthetic, " + words, synthetic(scene, home, recipe, shift)) for words, shift in _PLACES]
        # Rendering has ingested the drive, if nobody had.
        rows += step_rows(name, recorded(SceneStore(home=home, scene=name)), drives)
    head = [
        "scene", "scans", "number", "runs differ by", "error of a step mm", "single runs mm",
        "over the recorded", "target",
    ]  # fmt: skip
    text = f"{machine()}; recipe `{recipe}`, seed 0, commit {commit()}.\n\n" + markdown_table(head, rows)
    print(text)
    write_between(PAGE, "odometry", text)


def step_rows(scene: str, drive: Drive, others: list[tuple[str, Drive]]) -> Iterator[list[str]]:
    """Rows of the recorded scans and of each of the others, for both ways of drawing the runs."""
    for way, redraw in (("axes turned", turned), ("points reordered", reordered)):
        own_m = errors_m(drive, redraw)
        yield [f"`{scene}`", "recorded", str(len(drive.scans)), way, *_spread(own_m), "", ""]
        for words, other in others:
            mine_m = errors_m(other, redraw)
            ratio = mine_m.mean() / own_m.mean()
            # Of independent means: relative errors add in squares.
            noise = ratio * np.hypot(*(x.std(ddof=1) / x.mean() / np.sqrt(len(x)) for x in (own_m, mine_m)))
            met = "✓" if ratio <= TARGET else "✗"
            yield [
                f"`{scene}`", words, str(len(other.scans)), way, *_spread(mine_m),
                f"{ratio:.2f} ± {noise:.2f}", f"{met} at most {TARGET:g}",
            ]  # fmt: skip


def _spread(errors_m: np.ndarray) -> tuple[str, str]:
    """Mean, and least to largest, in millimetres."""
    low, high = 1e3 * errors_m.min(), 1e3 * errors_m.max()
    return f"{1e3 * errors_m.mean():.1f}", f"{low:.1f} to {high:.1f}"


def errors_m(drive: Drive, redraw: Callable[[Drive, int], Drive]) -> np.ndarray:
    """The odometry's error in each of the runs: (runs,), metres.

    Each is the median over all steps of the distance between KISS-ICP's step and the commanded one.
    """
    drives = (redraw(drive, run) for run in range(_RUNS))
    return np.array([step_error_m(odometry_path(one.scans), one.poses) for one in drives])


def turned(drive: Drive, run: int) -> Drive:
    """The same drive by a sensor whose axes are turned about z: other coordinates, same times."""
    angle_rad = _QUARTER_RAD * run / _RUNS
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.eye(4)
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    scans = [(points_m @ turn[:3, :3].T, fraction) for points_m, fraction in drive.scans]
    return Drive(scans, drive.poses @ turn.T)


def reordered(drive: Drive, run: int) -> Drive:
    """The same drive with the points of each scan in another order."""
    rng = np.random.default_rng(run)
    orders = [rng.permutation(len(points_m)) for points_m, _ in drive.scans]
    scans = [(p[order], f[order]) for (p, f), order in zip(drive.scans, orders, strict=True)]
    return Drive(scans, drive.poses)


def recorded(store: SceneStore) -> Drive:
    """The recorded scans of an ingested scene."""
    a = read_arrays(
        store.require("sweeps") / "returns.zarr", "offsets", "points_m", "sweep_fraction", "lidar_to_world"
    )
    parts = [slice(first, last) for first, last in zip(a["offsets"], a["offsets"][1:], strict=False)]
    scans = [(a["points_m"][part].astype(np.float64), a["sweep_fraction"][part]) for part in parts]
    return Drive(scans, a["lidar_to_world"])


def synthetic(scene: SceneEntry, home: Path, recipe: str, shift_m: tuple[float, float, float]) -> Drive:
    """All frames of a scene as a data set, its scans sampled and noisy, from a shifted path."""
    keys = {"name": "odometry", "shift_m": list(shift_m), "cameras": [], "exports": ["bin"]}
    with tempfile.TemporaryDirectory(dir=home) as folder:
        render_view(replace(scene, views=()), keys, home, out=folder, recipe=recipe)
        return read_scans(Path(folder))


def read_scans(folder: Path) -> Drive:
    """The scans of a data set with the format `bin`, their points' times as the files beside them say."""
    rows = read_document(folder / "manifest.json")["scans"]
    period_s = float(np.median(np.diff([row["stamp_s"] for row in rows])))
    scans = []
    for row in rows:
        points = np.fromfile(folder / row["files"]["bin"], "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
        scans.append((points, np.fromfile(folder / row["files"]["time"], "<f4") / period_s))
    return Drive(scans, np.array([row["lidar_to_world"] for row in rows]).reshape(-1, 4, 4))


if __name__ == "__main__":
    main()
