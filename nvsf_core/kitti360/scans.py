"""LiDAR scans: `.bin` files of float32 x, y, z in metres and reflectance 0..1."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.errors import DataError

MAX_RANGE_M = 200.0
"""No return of a spinning car LiDAR is farther: beyond it, the numbers are garbage."""
MAX_ABSURD_SHARE = 0.01
"""With more garbage than this, the scan is not trusted at all."""

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


def read_scan(path: Path) -> np.ndarray:
    """Read a scan's usable returns, (N, 4) float32, in file order.

    Raises:
        DataError: See `load_scan`.
    """
    return load_scan(path).points


def load_scan(path: Path) -> Scan:
    """Read and validate a scan.

    Raises:
        DataError: The file is absent, truncated, without returns, or more than 1 % of it is absurd.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"no scan file {path} ({error.strerror}); unpack the drive's scans") from error
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
