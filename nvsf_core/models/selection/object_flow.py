"""Chooses which moving objects get a flow: those that it helps on scans left out of their evidence."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import ObjectEvidence
from nvsf_core.models.selection.holdout import is_sure
from nvsf_core.models.selection.voxel_size import mean_range_error_m

_MOST_VALIDATED = 12
"""Most scans of an object that are left out, one after the other."""
_VALIDATED_FIRST = 4
"""If the flow does not help on these, the others are not tried: most objects are rigid, a score is slow."""
_FEWEST_VALIDATED = 6
_FEWEST_RETURNS = 20
_RESOLVED_M = 30.0
"""Farther away the rows of 64 lasers are over 20 cm apart on an object, too coarse for limbs."""
_WORST_M = 0.5
"""Largest error of a ray in the score."""


def choose_flow(objects: tuple[ObjectEvidence, ...]) -> tuple[ObjectEvidence, ...]:
    """The same objects; with a flow those whose range error on left-out scans it surely lowers.

    The flow of a rigid object is noise and makes it worse, so it gets none.
    """
    return tuple(one.with_flow() if _bends(one) else one for one in objects)


def _bends(one: ObjectEvidence) -> bool:
    validation = _validation_scans(one)
    if len(validation) < _FEWEST_VALIDATED:
        return False
    # Shuffled evenly, so that the first few are spread over the drive.
    order = np.argsort(np.arange(len(validation)) * 0.618 % 1.0)
    gains = [_gain_m(one, int(scan)) for scan in validation[order[:_VALIDATED_FIRST]]]
    if np.mean(gains) <= 0.0:
        return False
    gains += [_gain_m(one, int(scan)) for scan in validation[order[_VALIDATED_FIRST:]]]
    return is_sure(gains)


def _validation_scans(one: ObjectEvidence) -> np.ndarray:
    """Numbers (j,) of at most 12 scans with 20 near returns of the object or more, not its first or last."""
    rays = one.rays
    near = rays.scan[rays.is_hit & (rays.range_m < _RESOLVED_M)]
    validation = np.array([s for s in one.path.scan[1:-1] if (near == s).sum() >= _FEWEST_RETURNS], np.int64)
    return validation[
        np.linspace(0, len(validation) - 1, min(len(validation), _MOST_VALIDATED)).astype(np.int64)
    ]


def _gain_m(one: ObjectEvidence, scan: int) -> float:
    """By how much a flow lowers the mean range error on a scan, rendered from the other scans."""
    time_s = float(one.path.time_s[np.searchsorted(one.path.scan, scan)])
    others = one.of_scans(one.scans_near(time_s, leave_out=scan))
    asked = one.rays.is_hit & (one.rays.scan == scan) & (one.rays.range_m < _RESOLVED_M)
    return _error_m(others, one, asked, time_s) - _error_m(others.with_flow(), one, asked, time_s)


def _error_m(shown: ObjectEvidence, one: ObjectEvidence, asked: np.ndarray, time_s: float) -> float:
    """Mean absolute range error of `shown` along the rays of `one` that `asked` (n,) bool selects."""
    surfels = shown.surfels_from(shown.path.scan, time_s)
    if surfels is None:
        return _WORST_M
    rays = one.rays.of(asked)
    return mean_range_error_m(
        surfels, rays.origin_m, rays.direction, rays.range_m, far_m=2.0 * _RESOLVED_M, worst_m=_WORST_M
    )
