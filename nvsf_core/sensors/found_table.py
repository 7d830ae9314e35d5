"""A table of lasers found from scans, for a rotating LiDAR that no table is known of.

Each laser's returns follow the model of `tables.LaserTable`, here its elevations,
    elevation = elevation_l + vertical_offset_l / r,
a straight line in 1 / r; its azimuths in `found_lattice`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nvsf_core.errors import DataError
from nvsf_core.sensors.found_lattice import find_lattice
from nvsf_core.sensors.lasers import ROW_ORDERS, elevation_of, rows_of
from nvsf_core.sensors.ray_origins import origin_words
from nvsf_core.sensors.tables import LaserTable

Scans = Sequence[tuple[np.ndarray, np.ndarray | None]]
"""Points (N, 3) in the sensor's frame, metres, and the laser (N,) of each as the recording numbers them."""

_NEAREST_M = 2.0
_FAR_M = 10.0
"""Elevations are separated by returns beyond this, where a lever arm of 5 cm turns them by 0.3 degrees."""
_FEWEST_RETURNS = 30
"""Returns of a laser below which it is not one."""
_MOST_LASERS = 256
_SPREAD_RAD = np.deg2rad(0.15)
"""Largest robust spread of a laser's elevations about its line; real lasers have 0.02 degrees."""
_LEAST_FITTING = 0.9
_NEARNESS_SPAN = 0.03
"""Least span of 1 / r, 1/m, that tells a lever arm: returns from 10 to 14 m."""
_LEAST_SPREAD_RAD = np.deg2rad(0.03)
"""Returns this near to a line are never outliers: it is the sensors' own noise."""
_APART_RAD = np.deg2rad(0.08)
"""Least gap between two lasers' elevations where neither rings nor the file's order tell them apart."""
_BY_GAPS = "separated by gaps between their elevations"


@dataclass(frozen=True, slots=True, eq=False)
class FoundTable:
    """A table, and why."""

    table: LaserTable
    evidence: str
    """How lasers were separated, and how well the model fits, in words and numbers."""


class _Line(NamedTuple):
    """Elevation of a laser's returns as a line in 1 / r."""

    elevation_rad: float
    """At infinite range."""
    arm_m: float
    """Lever arm upwards."""
    spread_rad: float
    """Robust spread of the returns about the line."""
    is_certain: bool
    """Whether the ranges differ enough to tell the lever arm."""


def find_table(scans: Scans, others: Scans = ()) -> FoundTable:
    """The table of lasers that recorded these scans.

    Args:
        scans: Some scans of one drive, in file order.
        others: More of its scans, asked for the rings that have few returns in those.

    Raises:
        DataError: There are no lasers to be separated; the message says what was tried.
    """
    groups, words, sparse = _told_apart(scans, others)
    or_ring = "" if _has_rings(scans) else ", or give each point its `ring`"
    advice = f"name the sensor (`lidar` of the scene){or_ring}"
    if not groups:
        raise DataError(
            f"lasers: {words}: expected {_FEWEST_RETURNS} returns of a laser beyond {_NEAREST_M:g} m in "
            f"{len(scans) + len(others)} scans, found none with as many; {advice}"
        )
    lines = _lines(groups)
    good = [k for k, one in enumerate(lines) if one.spread_rad <= _SPREAD_RAD]
    if not good or 2 * len(good) < len(groups):
        doubt = (
            "is this one scan of one rotating LiDAR, in its own frame, not merged with another's and not "
            f"corrected for motion? If so, {advice}"
        )
        raise DataError(
            f"lasers: {words}, and {len(groups) - len(good)} of {len(groups)} look into more than one "
            f"direction: {origin_words(groups) or doubt}"
        )
    order = sorted(good, key=lambda k: -lines[k].elevation_rad)
    left_out = len(groups) - len(order) + sparse
    # A ring of too few returns is no laser here: its returns are not asked for one.
    far_of = groups if _has_rings(scans) else [points_m for points_m, _ in scans]
    groups, lines = [groups[k] for k in order], [lines[k] for k in order]
    # Gaps leave out whole lasers, of which no return is far.
    beyond_m = _NEAREST_M if words == _BY_GAPS else _FAR_M
    fitting = _fitting(far_of, lines, beyond_m)
    if fitting < _LEAST_FITTING:
        raise DataError(
            f"lasers: {words}, found {len(groups)}, but {fitting:.0%} of the returns beyond "
            f"{beyond_m:g} m lie on one of them, expected {_LEAST_FITTING:.0%}; "
            f"{origin_words(groups) or advice}"
        )
    lattice = find_lattice(groups, len(scans))
    farthest_m = max(float(np.linalg.norm(points_m[:, :3], axis=1).max()) for points_m in groups)
    table = LaserTable(
        name=f"found-{len(groups)}",
        elevation_rad=np.array([line.elevation_rad for line in lines]),
        vertical_offset_m=np.array([line.arm_m for line in lines]),
        horizontal_offset_m=lattice.arms_m,
        phase_steps=lattice.phases,
        firing_shift_steps=lattice.shifts,
        lattice_steps=lattice.steps,
        firings_per_turn=lattice.firings,
        max_range_m=float(np.ceil(1.02 * farthest_m)),
        elevation_correction_rad=0.0,
        range_bias_m=np.zeros(len(groups)),
        intensity_gain=np.ones(len(groups)),
    )
    spread_deg = np.degrees(np.median([line.spread_rad for line in lines]))
    elevations = np.degrees([lines[0].elevation_rad, lines[-1].elevation_rad])
    evidence = (
        f"{len(groups)} lasers from {len(scans)} scans, {words}: {elevations[0]:.2f} to {elevations[1]:.2f} "
        f"degrees, {spread_deg:.3f} degrees off their lines in the median; {table.firings_per_turn} firings; "
        f"{lattice.words}; {left_out or 'none'} left out"
    )
    return FoundTable(table, evidence)


def _fitting(clouds: Sequence[np.ndarray], lines: Sequence[_Line], beyond_m: float) -> float:
    """Share of the clouds' returns beyond a range within 0.15 degrees of a laser's line."""
    found = [elevation_of(points_m) for points_m in clouds]
    elevation, range_m = (np.concatenate(parts) for parts in zip(*found, strict=True))
    far = range_m > beyond_m
    off = np.full(int(far.sum()), np.inf)
    for line in lines:
        off = np.minimum(off, np.abs(elevation[far] - line.arm_m / range_m[far] - line.elevation_rad))
    return float((off <= _SPREAD_RAD).mean()) if len(off) else 1.0


def _has_rings(scans: Scans) -> bool:
    return all(ring is not None for _, ring in scans)


def _told_apart(scans: Scans, others: Scans) -> tuple[list[np.ndarray], str, int]:
    """What `_grouped` gives, how lasers were separated, and the rings left out for their few returns."""
    if _has_rings(scans):
        return _by_ring(scans, [(points_m, ring) for points_m, ring in others if ring is not None])
    if groups := _by_order(scans):
        return groups, "separated by the file's order, one rotation each", 0
    elevations = _telling_elevations(scans)
    bands = _bands(np.concatenate(elevations))
    if not 2 <= len(bands) - 1 <= _MOST_LASERS:
        raise DataError(
            f"lasers: found {max(0, len(bands) - 1)} directions in the points' elevations, no `ring`, and no "
            "order in the file; name the sensor (`lidar` of the scene), or give each point its `ring`"
        )
    bins = [np.digitize(elevation, bands) - 1 for elevation in elevations]
    labels = [np.where(band < len(bands) - 1, band, -1) for band in bins]
    return _full(_grouped(scans, labels)), _BY_GAPS, 0


def _by_order(scans: Scans) -> list[np.ndarray]:
    """Groups of the file's rows, by the order in which most of them look one way; empty if none does."""
    best: list[np.ndarray] = []
    best_share = 0.5
    for order in ROW_ORDERS:
        rows = [rows_of(points_m, *order) for points_m, _ in scans]
        counts = {int(row.max(initial=-1)) + 1 for row in rows}
        if len(counts) != 1 or not 2 <= max(counts) <= _MOST_LASERS:
            continue
        groups = _full(_grouped(scans, rows))
        share = float(np.mean([one.spread_rad <= _SPREAD_RAD for one in _lines(groups)] or [False]))
        if share > best_share:
            best, best_share = groups, share
    return best


def _by_ring(
    scans: Scans, others: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[list[np.ndarray], str, int]:
    """As `_told_apart`; a ring of few returns in the scans has those of the others, too, numbered on."""
    rings = [np.asarray(ring) for _, ring in scans]
    groups = _grouped(scans, rings)
    full = [ring for ring, rows in groups.items() if len(rows) >= _FEWEST_RETURNS]
    few = []
    for points_m, ring in others:
        is_few = ~np.isin(ring, full)
        few.append((points_m[is_few], ring[is_few]))
    rings += [ring for _, ring in few]
    if any(len(ring) for _, ring in few):
        groups = _grouped([*scans, *few], rings)
    found = _full(groups)
    sparse = len(np.unique(np.concatenate(rings))) - len(found)
    said = f", {len(found) - len(full)} of them in all {len(rings)} scans" if len(found) > len(full) else ""
    if sparse:
        said += f", {sparse} with fewer than {_FEWEST_RETURNS} returns each"
    return found, f"separated by their `ring`{said}", sparse


def _full(groups: dict[int, np.ndarray]) -> list[np.ndarray]:
    """The groups with enough returns for a laser."""
    return [group for group in groups.values() if len(group) >= _FEWEST_RETURNS]


def _grouped(scans: Scans, labels: Sequence[np.ndarray]) -> dict[int, np.ndarray]:
    """(N, 4) float64 of each label, from 0 on: its points, metres, and the scan that each is of."""
    points_m = np.concatenate([points for points, _ in scans]).astype(np.float64)
    scan = np.repeat(np.arange(len(scans)), [len(points) for points, _ in scans])
    label = np.concatenate(labels)
    kept = (np.linalg.norm(points_m, axis=1) > _NEAREST_M) & (label >= 0)
    rows, label = np.column_stack([points_m, scan])[kept], label[kept]
    return {int(one): rows[label == one] for one in np.unique(label)}


def _telling_elevations(scans: Scans) -> list[np.ndarray]:
    """Elevations (N,) of far returns, and of those below all far ones; NaN of the others.

    Steep lasers meet the road near by. There its height hardly differs, and a lever arm does no harm.
    """
    found = [elevation_of(points_m) for points_m, _ in scans]
    far = np.concatenate([elevation[range_m > _FAR_M] for elevation, range_m in found])
    steep_rad = np.percentile(far, 0.1) - _APART_RAD if len(far) else -np.inf
    return [
        np.where((range_m > _FAR_M) | ((range_m > _NEAREST_M) & (elevation < steep_rad)), elevation, np.nan)
        for elevation, range_m in found
    ]


def _bands(elevation: np.ndarray) -> np.ndarray:
    """Limits of each laser's elevations: the middles of the gaps between those given (N,); NaN = unused."""
    elevation = elevation[np.isfinite(elevation)]
    if len(elevation) < _FEWEST_RETURNS:
        return np.zeros(0)
    # Gaps are of a histogram, where single stray returns do not close them.
    width = 0.25 * _APART_RAD
    count, edge = np.histogram(
        elevation, np.arange(elevation.min() - width, elevation.max() + 2 * width, width)
    )
    is_empty = count <= max(1.0, 0.02 * np.percentile(count[count > 0], 90))
    start, end = np.flatnonzero(np.diff(is_empty, prepend=False, append=False)).reshape(-1, 2).T
    is_gap = (start > 0) & (end < len(count)) & (end - start >= 2)
    return np.concatenate([edge[:1], 0.5 * (edge[start] + edge[end])[is_gap], edge[-1:]])


def _lines(groups: Sequence[np.ndarray]) -> list[_Line]:
    """The line of each laser; one whose returns have all one range takes the lever arm of its neighbour."""
    lines = [_line(points_m) for points_m in groups]
    known = [k for k, one in enumerate(lines) if one.is_certain]
    for k, one in enumerate(lines):
        if one.is_certain or not known:
            continue
        near = min(known, key=lambda other: abs(lines[other].elevation_rad - one.elevation_rad))
        arm_m = lines[near].arm_m
        elevation, range_m = elevation_of(groups[k])
        base = float(np.median(elevation - arm_m / range_m))
        spread = 1.4826 * float(np.median(np.abs(elevation - arm_m / range_m - base)))
        lines[k] = _Line(base, arm_m, spread, is_certain=False)
    return lines


def _line(points_m: np.ndarray) -> _Line:
    """The line of one laser's elevations over 1 / r, without its outliers."""
    elevation, range_m = elevation_of(points_m)
    nearness = 1.0 / range_m
    kept = np.ones(len(elevation), np.bool_)
    line = _Line(float(np.median(elevation)), 0.0, float("inf"), is_certain=False)
    for _ in range(4):
        low, high = np.percentile(nearness[kept], [2.0, 98.0])
        is_certain = bool(high - low > _NEARNESS_SPAN)
        arm_m, base = (
            np.polyfit(nearness[kept], elevation[kept], 1) if is_certain else (0.0, line.elevation_rad)
        )
        off = np.abs(elevation - base - arm_m * nearness)
        line = _Line(float(base), float(arm_m), 1.4826 * float(np.median(off)), is_certain)
        kept = off <= max(3.0 * line.spread_rad, _LEAST_SPREAD_RAD)
    return line
