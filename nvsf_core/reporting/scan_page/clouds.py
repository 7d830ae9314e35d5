"""The clouds that the page shows: a view's scans and, at the same place and time, the recorded ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from nvsf_core.geometry.se3 import invert_pose, transform_points
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.stores.arrays import holds_array, read_arrays, read_part

MOST_INSTANTS = 12
"""Of a longer view, so many instants are shown, evenly apart."""
FAR_M = 1.0
"""Errors are shown up to this."""
RECORDED = 3
"""`support` of recorded points, above those of `Support`."""
_NEAR_SCANS = 3
_UNKNOWN = RECORDED


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """N points of a scan, in the frame of the view's sensor at its stamp."""

    points_m: np.ndarray
    """(N, 3) float64, metres."""
    intensity: np.ndarray
    """(N,) 0..1."""
    support: np.ndarray
    """(N,) uint8: `Support`, or `RECORDED`, also where it is not known."""
    error_m: np.ndarray
    """(N,) distance to the nearest point that it is compared with, `FAR_M` at most."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Instant:
    """One instant of a view."""

    time_s: float
    frame: int
    """Nearest recorded frame."""
    synthetic: Cloud
    recorded: Cloud | None
    """None if that frame has no scan."""


def instants_of(root: Path, view: Path) -> list[Instant]:
    """The instants to show of a view.

    Synthetic points are compared with the recorded scan of the same frame if it was held out, else with the
    three recorded scans that are nearest; recorded points with the synthetic scan.

    Raises:
        StoreError: What is stored is damaged.
    """
    path = view / "model.zarr"
    a = read_arrays(path, "frame", "time_s", "offsets", "lidar_to_world")
    scans = _RecordedScans(root / "sweeps" / "returns.zarr")
    has_support = holds_array(path, "support")
    names = ("points_m", "intensity", *(("support",) if has_support else ()))
    rows = np.unique(np.linspace(0, len(a["frame"]) - 1, MOST_INSTANTS).round().astype(int))
    shown = []
    for row in rows.tolist():
        part = read_part(path, slice(int(a["offsets"][row]), int(a["offsets"][row + 1])), *names)
        frame, pose = int(a["frame"][row]), a["lidar_to_world"][row]
        near = scans.nearest(frame, 1 if view.name == HELD_OUT else _NEAR_SCANS)
        points_m = part["points_m"].astype(np.float64)
        others = [scans.seen_from(one, pose)[0] for one in near]
        support = part["support"] if has_support else np.full(len(points_m), _UNKNOWN, np.uint8)
        synthetic = Cloud(points_m, part["intensity"], support, _distance_m(points_m, others))
        recorded = None
        if frame in scans.row:
            own_m, intensity = scans.seen_from(frame, pose)
            recorded = Cloud(
                own_m, intensity, np.full(len(own_m), RECORDED, np.uint8), _distance_m(own_m, [points_m])
            )
        shown.append(
            Instant(time_s=float(a["time_s"][row]), frame=frame, synthetic=synthetic, recorded=recorded)
        )
    return shown


class _RecordedScans:
    """Recorded scans, read one at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.row: dict[int, int] = {}
        if path.is_dir():
            self._arrays = read_arrays(path, "frame", "offsets", "lidar_to_world")
            self.row = {int(frame): row for row, frame in enumerate(self._arrays["frame"])}

    def nearest(self, frame: int, count: int) -> list[int]:
        """The `count` recorded frames nearest to a frame."""
        return sorted(self.row, key=lambda one: abs(one - frame))[:count]

    def seen_from(self, frame: int, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (m, 3) of a recorded scan in the frame of `pose` (4, 4), metres, and intensities (m,)."""
        a, row = self._arrays, self.row[frame]
        part = slice(int(a["offsets"][row]), int(a["offsets"][row + 1]))
        stored = read_part(self._path, part, "points_m", "intensity")
        moved = transform_points(invert_pose(pose) @ a["lidar_to_world"][row], stored["points_m"])
        return moved, stored["intensity"]


def _distance_m(points_m: np.ndarray, others: Sequence[np.ndarray]) -> np.ndarray:
    """(N,) distance to the nearest point of the others, `FAR_M` at most, also where there is none."""
    found = np.full(len(points_m), FAR_M)
    for other in others:
        if len(other) and len(points_m):
            # Unbalanced: built in a fifth of the time, searched as fast.
            tree = KDTree(other, balanced_tree=False, compact_nodes=False)
            distance_m, _ = tree.query(points_m, distance_upper_bound=FAR_M)
            found = np.minimum(found, distance_m)
    return found
