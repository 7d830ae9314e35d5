"""LiDAR scans as `.bin` files of float32 x, y, z in metres and reflectance 0..1: read, validated, written."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.text import read_bytes
from nvsf_core.drives.point_times import after_frame
from nvsf_core.errors import DataError, ShapeError

MAX_RANGE_M = 300.0
"""Longer than the range of any rotating car LiDAR (245 m of a VLS-128); points beyond it are absurd."""
MAX_ABSURD_SHARE = 0.01
"""Scans with a larger share of absurd points are refused."""

MOST_RETURNS = 2 * 128 * 4096
"""Most returns of a sweep: two of each of 128 lasers at each of 4096 columns, the largest there is."""

COLUMNS = {"ring": "<u2", "time": "<f4"}
"""What files beside a scan may hold of each of its points, and as which numbers: of plain drives, and of
trees that this project wrote."""

_BYTES_PER_RETURN = 16
_REMEDIES = ("", "give points in metres, in the sensor's own frame, or ", "scale intensities to 0..1, or ")
"""Against points that are not finite, too far, or too bright."""
_LEAST_BRIGHTEST = 0.02
"""Intensity of a drive's brightest return: signs and number plates of any street shine back far more."""


@dataclass(frozen=True, slots=True)
class Scan:
    """The usable returns of a scan, in file order."""

    points: np.ndarray
    """(N, 4) float32: x, y, z (sensor frame, metres), reflectance 0..1."""
    n_absurd: int
    """Points left out as NaN, infinite, beyond `MAX_RANGE_M`, or with a reflectance outside 0..1."""
    ring: np.ndarray | None = None
    """(N,) int64, number of the laser as the recording has it, in no known order; None = not recorded."""
    offset_s: np.ndarray | None = None
    """(N,) float64, time of each return after the frame's, seconds; None = not recorded."""


def read_scan_bytes(path: Path) -> bytes:
    """The bytes of a scan's file, not validated.

    Raises:
        DataError: It is absent, not a regular file, or too large for a scan.
    """
    return read_bytes(path, _BYTES_PER_RETURN * MOST_RETURNS, "scan")


def read_columns(paths: Mapping[str, Path]) -> tuple[tuple[str, bytes], ...]:
    """The bytes of files beside a scan, by names of `COLUMNS`, not validated.

    Raises:
        DataError: One is not a regular file, or too large for a scan.
    """
    return tuple((name, read_bytes(path, 4 * MOST_RETURNS, "scan")) for name, path in paths.items())


def parse_columns(path: Path, beside: Iterable[tuple[str, bytes]], count: int) -> dict[str, np.ndarray]:
    """Values (count,) of the points of a scan, by their names, from the bytes of files beside it.

    Raises:
        DataError: A file has not one value a point.
    """
    columns = {}
    for name, data in beside:
        kind = np.dtype(COLUMNS[name])
        if len(data) != count * kind.itemsize:
            raise DataError(
                f"{path}: expected {count} values {COLUMNS[name]}, one {name} a point, found {len(data)} "
                f"bytes in the file of {name} beside it; copy both again, or remove that file"
            )
        columns[name] = np.frombuffer(data, kind)
    return columns


def parse_scan(path: Path, data: bytes, beside: Iterable[tuple[str, bytes]] = ()) -> Scan:
    """Validate and decode a scan, with the rings and times that files beside it hold.

    Raises:
        DataError: It is truncated, has no returns, or more than 1 % of its points are absurd; or what lies
            beside it is not of its points, or times are no scan's.
    """
    if len(data) % _BYTES_PER_RETURN:
        raise DataError(
            f"{path}: truncated scan, {len(data)} bytes are no multiple of {_BYTES_PER_RETURN}; copy it again"
        )
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    columns = parse_columns(path, beside, len(points))
    time = columns.get("time")
    if time is not None and not time.any():
        time = None  # of one instant: they say nothing of when the sensor looked where
    if time is not None:
        time = after_frame(f"{path}: time", time, np.asarray(points[:, :3].any(axis=1)), None)
    return usable_scan(path, points, columns.get("ring"), time)


def usable_scan(
    path: Path, points: np.ndarray, ring: np.ndarray | None = None, offset_s: np.ndarray | None = None
) -> Scan:
    """The usable returns of decoded rows.

    Args:
        path: The file, for messages.
        points: (M, 4) float32 x, y, z in metres and reflectance.
        ring: (M,) laser of each; None = not recorded.
        offset_s: (M,) time of each after the frame's; None = not recorded.

    Raises:
        DataError: There are no returns, more than `MOST_RETURNS`, or more than 1 % of the points are absurd.
    """
    finite = np.isfinite(points).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        range_m = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
        in_reach = range_m <= MAX_RANGE_M
        plausible = (points[:, 3] >= 0.0) & (points[:, 3] <= 1.0)
    # Some drivers write dropped rays as points at the sensor's origin: these are left out, too.
    empty = finite & (range_m == 0.0)
    absurd = ~(finite & in_reach & plausible) & ~empty
    n_absurd, n_rows = int(absurd.sum()), len(points)
    if n_absurd > MAX_ABSURD_SHARE * n_rows:
        counts = [int(one.sum()) for one in (~finite, finite & ~in_reach, finite & in_reach & ~plausible)]
        raise DataError(
            f"{path}: {n_absurd} of {n_rows} returns are absurd ({counts[0]} not finite, {counts[1]} beyond "
            f"{MAX_RANGE_M:.0f} m, {counts[2]} with reflectance outside 0..1), expected at most "
            f"{MAX_ABSURD_SHARE:.0%}; {_REMEDIES[int(np.argmax(counts))]}copy it again where it is damaged"
        )
    usable = ~(absurd | empty)
    if not usable.any():
        raise DataError(f"{path}: the scan has no returns; copy it again")
    # What is written of a scan must be read again, whose size is checked by its file's.
    if usable.sum() > MOST_RETURNS:
        raise DataError(
            f"{path}: expected at most {MOST_RETURNS:,} returns of one sensor's sweep, found "
            f"{int(usable.sum()):,}; give each sensor's scans by themselves, and one sweep a scan"
        )
    return Scan(
        points[usable].astype(np.float32),
        n_absurd,
        ring=None if ring is None else ring[usable].astype(np.int64),
        offset_s=None if offset_s is None else offset_s[usable].astype(np.float64),
    )


def notes_on_brightest(intensity: float) -> list[str]:
    """A note where the brightest return of a drive, 0..1, tells that intensities are of a smaller scale.

    Where none is above 0 they are not recorded, which is no error.
    """
    if not 0.0 < intensity < _LEAST_BRIGHTEST:
        return []
    return [
        f"the brightest return of all scans has an intensity of {intensity:.2g}, expected "
        f"{_LEAST_BRIGHTEST:g} to 1: another scale? What is rendered will be as dark; where intensity_max "
        "of drive.json is too large, correct it"
    ]


def write_scan(path: Path, points_m: np.ndarray, intensity: np.ndarray) -> None:
    """Write a LiDAR scan as float32 x, y, z, reflectance, in the given order.

    Args:
        path: File to write; its folder is made.
        points_m: (N, 3) in the sensor's frame, each at its own time.
        intensity: (N,) in 0..1.

    Raises:
        ShapeError: The arrays have other shapes.
        DataError: A value is not finite.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3 or intensity.shape != (len(points_m),):
        raise ShapeError(
            "expected points (N, 3) and intensity (N,), found "
            f"{points_m.shape} and {intensity.shape} for {path}; pass one row a return"
        )
    rows = np.column_stack([points_m, intensity]).astype("<f4")
    if not np.isfinite(rows).all():
        raise DataError(f"expected finite returns for {path}, found others; leave those returns out")
    write_column(path, rows)


def write_column(path: Path, values: np.ndarray) -> None:
    """Write numbers, as a scan or one value of each of its returns, as bare bytes; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not `tofile`, whose error does not say that the disk is full.
    path.write_bytes(values.tobytes())
