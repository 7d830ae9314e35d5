"""Whether what moves is rigid: how far its returns lie off what the scans beside show of it."""

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.evidence.objects import ObjectEvidence

FAR_OFF_M = 0.1
"""A return farther off its surface than this would be seen to be wrong."""
NEIGHBOURS = 8
"""Returns that tell a plane."""
_UNSEEN_M = 0.5
"""Without a return so near in a scan a place was not seen by it: no surface to compare with."""
_RESOLVED_M = 30.0
"""Farther away 64 lasers lie over 20 cm apart on a thing: a single scan does not show its surface."""


def surface_distance_m(point_m: np.ndarray, seen_m: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 3) to the plane through the 8 nearest of others (m, 3), m >= 8.

    NaN where the nearest lies more than 0.5 m off.
    """
    near_m, near = cKDTree(seen_m).query(point_m, NEIGHBOURS)
    around = seen_m[near]
    centre = around.mean(axis=1)
    apart = around - centre[:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))
    distance = np.abs(np.einsum("ni,ni->n", point_m - centre, axes[:, :, 0]))
    return np.where(near_m[:, 0] <= _UNSEEN_M, distance, np.nan)


def not_rigid_share(objects: tuple[ObjectEvidence, ...]) -> float | None:
    """Share of moving returns over 10 cm off what the scan before or the scan after shows of their thing.

    Scans are laid over each other by the thing's rigid path. Of returns within 30 m whose place one of the
    two saw; None without any. Edges of rigid things and errors of the path are among them: up to a tenth.
    """
    off_m = np.concatenate([[], *(_off_m(one) for one in objects)])
    return float((off_m > FAR_OFF_M).mean()) if len(off_m) else None


def _off_m(one: ObjectEvidence) -> np.ndarray:
    """Distances (n,) of an object's returns to its surface, the larger of what the two scans beside say.

    One scan at a time: of a limb between two places that it had the mean is no distance.
    """
    rays = one.rays
    point_o = rays.origin_m + rays.direction * rays.range_m[:, None]
    seen = [np.flatnonzero(rays.is_hit & (rays.scan == scan)) for scan in one.path.scan]
    found = [np.zeros(0)]
    for number, own in enumerate(seen):
        near = own[rays.range_m[own] < _RESOLVED_M]
        beside = [other for other in seen[max(0, number - 1) : number + 2] if other is not own]
        told = [surface_distance_m(point_o[near], point_o[o]) for o in beside if len(o) >= NEIGHBOURS]
        if told and len(near):
            off_m = np.fmax.reduce(told)
            found.append(off_m[np.isfinite(off_m)])
    return np.concatenate(found)
