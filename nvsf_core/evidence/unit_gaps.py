"""Gaps of the recorded unit: firings that never return, whatever stands there.

Parts of its vehicle hide them, or its own housing: the HDL-64E on KITTI-360's car has a comb of gaps on both
sides. They are the same wherever the vehicle drives, while what the scene drops moves past. They belong to
this unit on this vehicle alone: to another sensor they tell nothing.
"""

import numpy as np
from scipy import ndimage

from nvsf_core.evidence.drop_prior import DropPrior

GAP_CELLS = 2000
"""Cells around the sensor."""
_LEAST_SCANS = 4
"""Scans at different places in which a firing must have met a surface."""
_NEVER_SHARE, _SELDOM_SHARE = 0.05, 0.5
"""Largest share of those that return: in a gap, and at its blurred ends."""
_END_CELLS = 3
"""Cells that a blurred end is long at most."""
_APART_M = 1.0


def places_apart(position_m: np.ndarray, most: int) -> np.ndarray:
    """Numbers (k,) of at most `most` scans whose sensors (n, 3) stand at least a metre apart in turn."""
    chosen = list[int]()
    for number, position in enumerate(position_m):
        if not chosen or np.linalg.norm(position - position_m[chosen[-1]]) >= _APART_M:
            chosen.append(number)
    some = np.unique(np.linspace(0, max(0, len(chosen) - 1), min(most, len(chosen))).round().astype(np.int64))
    return np.array(chosen, np.int64)[some]


def find_unit_gaps(prior: DropPrior, scans: np.ndarray, is_met: np.ndarray) -> np.ndarray | None:
    """Which (lasers, 2000) bool cells of laser and sweep fraction lie in a gap.

    Args:
        prior: Returns of the training scans.
        scans: (k,) some of them, recorded at different places.
        is_met: (k, lasers, 2000) bool: whether a ray through the middle of a cell meets a surface.

    Returns:
        None where there are too few scans to tell a gap from what the scene drops.
    """
    if len(scans) < _LEAST_SCANS:
        return None
    middle = ((np.arange(GAP_CELLS) + 0.5) / GAP_CELLS - 0.5).astype(np.float32)
    met, returned = np.zeros((2, prior.laser_count, GAP_CELLS), np.int64)
    for scan, meets in zip(scans, is_met, strict=True):
        met += meets
        returned += meets & prior.is_hit[scan][:, prior.nearest_firing(int(scan), middle)]
    is_told = met >= max(_LEAST_SCANS, len(scans) // 2)
    never = is_told & (returned <= _NEVER_SHARE * met)
    seldom = is_told & (returned < _SELDOM_SHARE * met)
    along = np.ones((1, 3), bool)
    return np.asarray(ndimage.binary_dilation(never, along, iterations=_END_CELLS, mask=seldom) | never)


def cells_of(fraction: np.ndarray, cells: int) -> np.ndarray:
    """Cells (f,) int64, of so many around the sensor, of sweep fractions (f,) -0.5..0.5."""
    found: np.ndarray = np.clip(np.floor((fraction + 0.5) * cells), 0, cells - 1).astype(np.int64)
    return found
