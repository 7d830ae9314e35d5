"""Poses found from scans alone, against a drive's own: KISS-ICP's, and refined as `nvsf import` refines them.

``NVSF_SCENES=... SCENES="k360_street street" python -m benchmarks.drives.found_poses`` (with the extra
`odometry`) ingests the scenes, if nobody had, finds their paths again, and writes the errors into
docs/drives.md.
"""

import os
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common.documents import DOCS, commit, markdown_table, write_between
from benchmarks.data_sets.odometry import recorded
from nvsf_core.drives.catalogue import home_from_environment
from nvsf_core.geometry.se3 import invert_pose
from nvsf_core.metrics.trust.path_error import step_error_m
from nvsf_core.stages import run_scene
from nvsf_core.stages.flow import FRAMES, SWEEPS
from nvsf_core.stages.imports.odometry import kiss_path, path_of_scans
from nvsf_core.stages.runner.run import find_scene
from nvsf_core.stores.scene_store import SceneStore

PAGE = DOCS / "drives.md"
_HEAD = [
    "scene", "poses by", "step mm", "rms forward, left, up cm", "rms turn °",
    "at the end forward, left, up cm", "turn at the end °",
]  # fmt: skip


def main() -> None:
    """Measure every scene, print the table, and write it into the page."""
    home, rows = home_from_environment(os.environ), []
    for name in (os.environ.get("SCENES") or "k360_street kitti0005_van_cyclist").split():
        run_scene(find_scene(name), home, stages=[FRAMES, SWEEPS])
        drive = recorded(SceneStore(home=home, scene=name))
        for words, path in found_paths(drive.scans):
            rows.append([f"`{name}`", words, *errors(path, drive.poses)])
    text = f"Commit {commit()}.\n\n" + markdown_table(_HEAD, rows)
    print(text)
    write_between(PAGE, "found poses", text)


def found_paths(scans: list[tuple[np.ndarray, np.ndarray]]) -> Iterator[tuple[str, np.ndarray]]:
    """The path (n, 4, 4) by KISS-ICP, and refined."""
    yield "KISS-ICP", kiss_path(lambda: iter(scans))
    yield "KISS-ICP, refined", path_of_scans(lambda: iter(scans)).poses


def errors(path: np.ndarray, own: np.ndarray) -> Iterator[str]:
    """Errors of a path (n, 4, 4) against a drive's own.

    They are: the median of the steps'; those of the poses after the best turn and shift of the whole path, in
    the sensor's mean axes; those of the last pose, seen from the first.
    """
    yield f"{1e3 * step_error_m(path, own):.1f}"
    turn = Rotation.from_matrix((own @ invert_pose(path))[:, :3, :3]).mean().as_matrix()
    off_m = own[:, :3, 3] - path[:, :3, 3] @ turn.T
    axes = Rotation.from_matrix(own[:, :3, :3]).mean().as_matrix()
    yield _centimetres(np.sqrt((((off_m - off_m.mean(axis=0)) @ axes) ** 2).mean(axis=0)))
    left = Rotation.from_matrix(turn @ path[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2)).magnitude()
    yield f"{np.degrees(np.sqrt((left**2).mean())):.3f}"
    ends = [invert_pose(one[0]) @ one[-1] for one in (path, own)]
    yield _centimetres(ends[0][:3, 3] - ends[1][:3, 3])
    yield f"{np.degrees(Rotation.from_matrix(ends[0][:3, :3].T @ ends[1][:3, :3]).magnitude()):.3f}"


def _centimetres(three_m: np.ndarray) -> str:
    return ", ".join(f"{100.0 * one:.1f}" for one in three_m)


if __name__ == "__main__":
    main()
