"""Labels returns as static or moved: something moved where later or earlier scans see through its surface.

Each return above the ground is looked up in the range image of every other scan, at the moment when that scan
looked there. Scans are visited outwards in time from the return's own. Foliage and edges are confirmed again
after a scan has seen through them; an object that drove away is not.
"""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.timed_returns import TimedReturns
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts
from nvsf_core.kernels.visibility import look_back

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
        """Returns (k,) int64 of a scan in a scene-local box that are not labelled static.

        Args:
            returns: All training returns.
            scan: Number of the scan.
            low_m: (3,) lower corner.
            high_m: (3,) upper corner.
        """
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
    time_s = returns.scan_time_s[:, None] + fraction * returns.period_s
    rotation, position_m = returns.trajectory.at(time_s.ravel())
    inverse = invert_pose(pose_from_parts(rotation, position_m))[:, :3]
    return inverse.reshape(returns.scan_count, moments, 3, 4).astype(np.float32)
