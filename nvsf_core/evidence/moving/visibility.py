"""Labels returns as static or moved: something moved where later or earlier scans see through its surface.

Each return above the ground is looked up in the range image of every other scan, at the moment when that scan
looked there. Scans are visited outwards in time from the return's own. Foliage and edges are confirmed again
after a scan has seen through them; an object that drove away is not.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from nvsf_core.errors import ShapeError
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts
from nvsf_core.kernels.visibility import look_back
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.sweep_clock import SweepClock
from nvsf_core.sensors.tables import LaserTable

CELL_M = 1.0
_MOST_RETURNS = 1_000_000
_MOST_CELLS = 4_000_000
_PERCENTILE = 0.03
_ABOVE_NEIGHBOURS_M = 0.6
"""A cell that much higher than the lowest within 3 m is not ground but a car's roof or a hedge."""
_MIRRORED_M, _MIRROR_PERCENTILE = 1.5, 25
"""A cell that much lower than the lower quartile within 7 m holds mirror images. It is left out first, so
that its height does not spread."""
_BELOW_NEIGHBOURS_M = 0.7
"""A cell that much lower than the median within 7 m holds mirror images from puddles or car bonnets."""
UNKNOWN, STATIC, SEED = 0, 1, 2
"""Label of a return: unknown; static; or of something that left, the seed of a cluster."""
_CELLS = 2000
_MOMENTS = 256
_MARGIN_M = 0.3
_MARGIN_PER_RANGE = 0.005
_LEAST_THROUGH = 3
_LATE_SHARE = 0.15
_CONFIRMED_SHARE = 0.5
_MOST_IMAGE_BYTES = 1 << 30


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
    period_s: float
    """Seconds of one sweep; 0 where all rays were put at the pose's instant."""
    table: LaserTable
    elevation_correction_rad: float
    """Angle by which rays were turned up."""
    clocks: tuple[SweepClock, ...] = ()
    """(n,) when in each scan's sweep an azimuth was measured; empty = as by `SweepClock()`."""

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


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Height of the ground in square cells."""

    origin_m: np.ndarray
    """(2,) float64, lower corner in x and y, scene-local metres."""
    height_m: np.ndarray
    """(a, b) float32, scene-local z in metres, by x and y cell."""
    cell_m: float = CELL_M

    def above(self, point_m: np.ndarray) -> np.ndarray:
        """Heights (N,) float32 metres of scene-local points (N, 3) above the ground of the nearest cell."""
        column = np.floor((point_m[:, :2] - self.origin_m) / self.cell_m).astype(np.int32)
        column = np.clip(column, 0, np.array(self.height_m.shape) - 1)
        return (point_m[:, 2] - self.height_m[column[:, 0], column[:, 1]]).astype(np.float32)


def build_ground(point_m: np.ndarray) -> GroundMap:
    """Height map of the ground below at least one return (N, 3), scene-local metres, z up.

    1. Each cell takes the third percentile of its z; it is emptied where that lies 1.5 m below the lower
       quartile of the 15 x 15 cells around.
    2. A cell 0.6 m above the lowest of the 7 x 7 cells around takes that height; empty ones take the nearest.
    3. Each cell takes the median of 3 x 3 cells; 0.7 m below the median of 15 x 15, it takes that median.
    """
    point_m = point_m[:: max(1, len(point_m) // _MOST_RETURNS)]
    # A few returns far off would make the map huge: beyond the extent of nearly all the border holds.
    low, high = np.quantile(point_m[:, :2], [0.0005, 0.9995], axis=0)
    # A drive of some square kilometres has coarser cells, so that its map has a bounded size.
    cell_m = CELL_M * max(1.0, float(np.ceil(np.sqrt(np.prod((high - low) / CELL_M) / _MOST_CELLS))))
    origin = np.floor(low / cell_m) * cell_m
    shape = np.maximum(np.ceil((high - origin) / cell_m).astype(np.int64), 1)
    cell = np.floor((point_m[:, :2] - origin) / cell_m).astype(np.int64)
    within = np.all((cell >= 0) & (cell < shape), axis=1)
    height = _percentile_by_cell(cell[within, 0] * shape[1] + cell[within, 1], point_m[within, 2], shape)
    low = ndimage.percentile_filter(_filled(height), _MIRROR_PERCENTILE, 15, mode="nearest")
    height[height < low - _MIRRORED_M] = np.inf
    lowest = ndimage.minimum_filter(height, 7, mode="nearest")
    height = np.where(height > lowest + _ABOVE_NEIGHBOURS_M, lowest, height)
    height = _filled(height)
    height = ndimage.median_filter(height, 3, mode="nearest")
    around = ndimage.median_filter(height, 15, mode="nearest")
    height = np.where(height < around - _BELOW_NEIGHBOURS_M, around, height)
    return GroundMap(origin, height.astype(np.float32), cell_m)


def _percentile_by_cell(cell: np.ndarray, z_m: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Third percentile of z in each cell, infinite where there is none."""
    height = np.full(int(shape.prod()), np.inf)
    order = np.lexsort((z_m, cell))
    ids, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    height[ids] = z_m[order][first + (_PERCENTILE * count).astype(np.int64)]
    return height.reshape(shape)


def _filled(height: np.ndarray) -> np.ndarray:
    """Infinite cells take the nearest finite cell's height."""
    nearest = ndimage.distance_transform_edt(
        ~np.isfinite(height), return_distances=False, return_indices=True
    )
    return height[tuple(nearest)]


@dataclass(frozen=True, slots=True, eq=False)
class AboveGround:
    """The returns that may move, because they lie above the ground, and what is known of each."""

    index: np.ndarray
    """(m,) int64 indices among all returns, ascending."""
    label: np.ndarray
    """(m,) int8 from `classify_returns`."""
    offsets: np.ndarray
    """(n + 1,) int64: scan k has the rows offsets[k] .. offsets[k + 1] - 1."""

    def of_scan(self, scan: int) -> tuple[np.ndarray, np.ndarray]:
        """`index` (k,) and `label` (k,) of one scan's returns."""
        part = slice(int(self.offsets[scan]), int(self.offsets[scan + 1]))
        return self.index[part], self.label[part]

    def loose_near(
        self, returns: TimedReturns, scan: int, low_m: np.ndarray, high_m: np.ndarray
    ) -> np.ndarray:
        """Returns (k,) int64 of a scan in a scene-local box, by its corners (3,), that are not static."""
        index, label = self.of_scan(scan)
        index = index[label != STATIC]
        point = returns.point_m[index]
        return index[np.all((point >= low_m) & (point <= high_m), axis=1)]


def classify_returns(returns: TimedReturns, above_ground: np.ndarray) -> np.ndarray:
    """Labels (m,) int8, UNKNOWN, STATIC or SEED, of the returns with the indices `above_ground` (m,) int64.

    All are UNKNOWN where fewer than two lasers are known.
    """
    lasers = np.unique(returns.laser[returns.laser >= 0])
    label = np.zeros(len(above_ground), np.int8)
    if len(lasers) < 2 or len(above_ground) == 0:
        return label
    images = _range_images(returns, lasers)
    counts = look_back(
        returns.point_m[above_ground],
        returns.scan_of(above_ground).astype(np.int32),
        images,
        _to_sensor(returns),
        (
            returns.table.elevation_rad[lasers].astype(np.float32),
            returns.table.vertical_offset_m[lasers].astype(np.float32),
            float(returns.elevation_correction_rad),
        ),
        _MARGIN_M,
        _MARGIN_PER_RANGE,
    )
    through, late, confirmed = counts[:, 0], counts[:, 1], counts[:, 2]
    came_back = late > _LATE_SHARE * through
    stayed = (through == 0) & (confirmed >= _CONFIRMED_SHARE * (returns.scan_count - 1))
    label[came_back | stayed] = STATIC
    label[(through >= _LEAST_THROUGH) & ~came_back] = SEED
    return label


def _range_images(returns: TimedReturns, lasers: np.ndarray) -> np.ndarray:
    """Range images (n, lasers, cells) float32 metres from the sensor's centre: nearest return, 0 = none."""
    firings = (returns.laser >= 0).sum() / (len(lasers) * returns.scan_count)
    # Cells narrower than the firings would stay empty, and nothing is learned from empty cells.
    cells = int(
        np.clip(firings, 16, min(_CELLS, _MOST_IMAGE_BYTES // (4 * len(lasers) * returns.scan_count)))
    )
    images = np.zeros((returns.scan_count, len(lasers), cells), np.float32)
    row_of_laser = np.full(returns.table.laser_count, -1)
    row_of_laser[lasers] = np.arange(len(lasers))
    for scan in range(returns.scan_count):
        part = returns.part(scan)
        known = returns.laser[part] >= 0
        x, y, z = returns.recorded_m[part][known].T
        range_m = np.sqrt(x * x + y * y + z * z)
        column = np.minimum(((0.5 - np.arctan2(y, x) / (2 * np.pi)) * cells).astype(np.int64), cells - 1)
        farthest_first = np.argsort(-range_m, kind="stable")
        row = row_of_laser[returns.laser[part][known]]
        images[scan, row[farthest_first], column[farthest_first]] = range_m[farthest_first]
    return images


def _to_sensor(returns: TimedReturns) -> np.ndarray:
    """Poses scene to sensor (n, k, 3, 4) float32 at k moments of each sweep."""
    moments = _MOMENTS if returns.period_s > 0 else 1
    fraction = (np.arange(moments) + 0.5) / moments - 0.5
    elapsed = np.array([clock.elapsed(fraction) for clock in returns.clocks]) if returns.clocks else fraction
    time_s = returns.scan_time_s[:, None] + elapsed * returns.period_s
    rotation, position_m = returns.trajectory.at(time_s.ravel())
    inverse = invert_pose(pose_from_parts(rotation, position_m))[:, :3]
    return inverse.reshape(returns.scan_count, moments, 3, 4).astype(np.float32)
