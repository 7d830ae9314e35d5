"""Which moving objects get a flow: those that scans left out show to move as no rigid motion explains."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import ObjectEvidence
from nvsf_core.models.selection.holdout import is_sure
from nvsf_core.models.selection.voxel_size import mean_range_error_m

_JUDGES = 12
"""Scans of an object that are left out in turn, at most."""
_FIRST_JUDGES = 4
"""Where the flow does not help these it is given up: most things are rigid, and judging takes a while."""
_FEWEST_JUDGES = 6
_FEWEST_RETURNS = 20
_RESOLVED_M = 30.0
"""Farther away 64 lasers lie over 20 cm apart on a thing: it shows no limbs."""
_WORST_M = 0.5
"""What a ray is at most off by in the score."""


def choose_flow(objects: tuple[ObjectEvidence, ...]) -> tuple[ObjectEvidence, ...]:
    """The same objects, with a flow where it answers left-out scans surely better than rigid motion alone.

    A rigid thing's flow is noise and makes it worse, so nothing is allocated for it.
    """
    return tuple(one.with_flow() if _bends(one) else one for one in objects)


def _bends(one: ObjectEvidence) -> bool:
    validation = _judges(one)
    if len(validation) < _FEWEST_JUDGES:
        return False
    # Spread over the drive, so that the first few have seen all of it.
    order = np.argsort(np.arange(len(validation)) * 0.618 % 1.0)
    gains = [_gain_m(one, int(scan)) for scan in validation[order[:_FIRST_JUDGES]]]
    if np.mean(gains) <= 0.0:
        return False
    gains += [_gain_m(one, int(scan)) for scan in validation[order[_FIRST_JUDGES:]]]
    return is_sure(gains)


def _judges(one: ObjectEvidence) -> np.ndarray:
    """At most 12 of its scans but for the first and the last (j,): those that saw enough of it near by."""
    rays = one.rays
    near = rays.scan[rays.is_hit & (rays.range_m < _RESOLVED_M)]
    validation = np.array([s for s in one.path.scan[1:-1] if (near == s).sum() >= _FEWEST_RETURNS], np.int64)
    return validation[np.linspace(0, len(validation) - 1, min(len(validation), _JUDGES)).astype(np.int64)]


def _gain_m(one: ObjectEvidence, scan: int) -> float:
    """How much nearer to a scan's returns the others answer with a flow than without one, mean over them."""
    time_s = float(one.path.time_s[np.searchsorted(one.path.scan, scan)])
    others = one.of_scans(one.scans_near(time_s, leave_out=scan))
    asked = one.rays.is_hit & (one.rays.scan == scan) & (one.rays.range_m < _RESOLVED_M)
    return _error_m(others, one, asked, time_s) - _error_m(others.with_flow(), one, asked, time_s)


def _error_m(shown: ObjectEvidence, one: ObjectEvidence, asked: np.ndarray, time_s: float) -> float:
    """Mean absolute range error along rays `asked` (n,) bool of an object as some of its scans show it."""
    surfels = shown.surfels_from(shown.path.scan, time_s)
    if surfels is None:
        return _WORST_M
    rays = one.rays.of(asked)
    return mean_range_error_m(
        surfels, rays.origin_m, rays.direction, rays.range_m, far_m=2.0 * _RESOLVED_M, worst_m=_WORST_M
    )
