"""The training returns as the search for moving objects needs them: point, time and laser of each."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable


@dataclass(frozen=True, slots=True, eq=False)
class TimedReturns:
    """N returns of n scans, ascending in the scans' times."""

    point_m: np.ndarray
    """(N, 3) float32, scene-local metres."""
    recorded_m: np.ndarray
    """(N, 3) float32 metres as recorded, in the moving sensor's frame."""
    laser: np.ndarray
    """(N,) int16, 0 on top, -1 unknown."""
    is_own_vehicle: np.ndarray
    """(N,) bool: on the recording car, which moves with the sensor, or mirrored by it."""
    time_s: np.ndarray
    """(N,) float64, each return's own instant."""
    offsets: np.ndarray
    """(n + 1,) int64: scan k's returns are offsets[k] .. offsets[k + 1] - 1."""
    scan_time_s: np.ndarray
    """(n,) float64: instants of the scans' poses, ascending."""
    trajectory: Trajectory
    """Poses of the sensor."""
    period_s: float
    """Seconds of one sweep; 0 where all rays were put at the pose's instant."""
    table: LaserTable
    """The sensor."""
    elevation_correction_rad: float
    """Angle by which rays were turned up."""

    def __post_init__(self) -> None:
        """Check that the arrays belong together.

        Raises:
            ShapeError: They do not.
        """
        n, count = len(self.scan_time_s), len(self.point_m)
        lengths = (len(self.recorded_m), len(self.laser), len(self.time_s))
        if self.offsets.shape != (n + 1,) or lengths != (count, count, count) or self.offsets[-1] != count:
            raise ShapeError(
                f"expected {count} returns in {n} scans, found lengths {lengths} and offsets "
                f"{self.offsets.shape} up to {self.offsets[-1:]}; pass arrays of the same scans"
            )

    @property
    def scan_count(self) -> int:
        """Number of scans n."""
        return len(self.scan_time_s)

    @property
    def frame_s(self) -> float:
        """Seconds from frame to frame, held-out frames included; all motion constants are per frame."""
        steps_s = np.diff(self.trajectory.times_s)
        return float(np.median(steps_s)) if len(steps_s) else 0.1

    @property
    def laser_spacing_rad(self) -> float:
        """Median angle between neighbouring lasers that returned; infinite where fewer than two did."""
        seen = np.flatnonzero(np.bincount(self.laser[self.laser >= 0], minlength=self.table.laser_count))
        steps = np.diff(np.unique(self.table.elevation_rad[seen]))
        return float(np.median(steps)) if len(steps) else np.inf

    def scan_of(self, index: np.ndarray) -> np.ndarray:
        """Numbers (k,) int64 of the scans of returns `index` (k,)."""
        return np.searchsorted(self.offsets, index, side="right") - 1

    def part(self, scan: int) -> slice:
        """Slice of a scan's returns in the flat arrays."""
        return slice(int(self.offsets[scan]), int(self.offsets[scan + 1]))
