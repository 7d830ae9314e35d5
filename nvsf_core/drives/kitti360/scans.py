"""LiDAR scans: `.bin` files of float32 x, y, z in metres and reflectance 0..1."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.text import read_bytes, require_unchanged
from nvsf_core.errors import DataError
from nvsf_core.sensors.tables import HDL_64E

MAX_RANGE_M = 200.0
"""No return of a spinning car LiDAR is farther: beyond it, the numbers are garbage."""
MAX_ABSURD_SHARE = 0.01
"""With more garbage than this, the scan is not trusted at all."""

MOST_RETURNS = 2 * HDL_64E.laser_count * HDL_64E.lattice_steps
"""Two returns of each laser at each step of the encoder: no turn of the sensor has more."""

_BYTES_PER_RETURN = 16


@dataclass(frozen=True, slots=True)
class Scan:
    """The usable returns of a scan, in file order, and what was left out."""

    points: np.ndarray
    """(N, 4) float32: x, y, z (sensor frame, metres), reflectance 0..1."""
    n_absurd: int
    """Returns dropped as NaN, infinite, beyond 200 m, or with a reflectance outside 0..1."""
    n_empty: int
    """Rows at the sensor's origin: how some drivers write a ray without an answer; dropped too."""


def read_scan(path: Path, checksum: str = "") -> np.ndarray:
    """Read a scan's usable returns, (N, 4) float32, in file order.

    Args:
        path: Of the scan.
        checksum: Of the file when it was validated (`checksum_of`); empty = not held against any.

    Raises:
        DataError: See `parse_scan`; or the file is absent, too large, or has changed since.
    """
    data = read_scan_bytes(path)
    require_unchanged(path, data, checksum)
    return parse_scan(path, data).points


def read_scan_bytes(path: Path) -> bytes:
    """A scan's file, whatever is in it.

    Raises:
        DataError: It is absent, no regular file, or larger than a scan of the sensor can be.
    """
    return read_bytes(path, _BYTES_PER_RETURN * MOST_RETURNS, "scan")


def parse_scan(path: Path, data: bytes) -> Scan:
    """Take a scan's file apart and validate it.

    Args:
        path: Where it is from, for messages.
        data: Its content.

    Raises:
        DataError: It is truncated, without returns, or more than 1 % of it is absurd.
    """
    if len(data) % _BYTES_PER_RETURN:
        raise DataError(
            f"{path}: truncated scan, {len(data)} bytes are no multiple of {_BYTES_PER_RETURN}; copy it again"
        )
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    finite = np.isfinite(points).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        range_m = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
        in_reach = range_m <= MAX_RANGE_M
        plausible = (points[:, 3] >= 0.0) & (points[:, 3] <= 1.0)
    empty = finite & (range_m == 0.0)
    absurd = ~(finite & in_reach & plausible) & ~empty
    n_absurd, n_rows = int(absurd.sum()), len(points)
    if n_absurd > MAX_ABSURD_SHARE * n_rows:
        raise DataError(
            f"{path}: {n_absurd} of {n_rows} returns are absurd ({int((~finite).sum())} not finite, "
            f"{int((finite & ~in_reach).sum())} beyond {MAX_RANGE_M:.0f} m, "
            f"{int((finite & in_reach & ~plausible).sum())} with reflectance outside 0..1), "
            f"expected at most {MAX_ABSURD_SHARE:.0%}; copy it again"
        )
    usable = points[~(absurd | empty)]
    if not len(usable):
        raise DataError(f"{path}: the scan has no returns; copy it again")
    return Scan(usable.astype(np.float32), n_absurd, int(empty.sum()))
