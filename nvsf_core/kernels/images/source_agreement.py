"""How well what a source image shows agrees with what all of them show, in numba.

Where a depth is wrong, or a source shows another surface, its colours differ from the others' over an area;
of a leaf or a stone, shown a fraction of a pixel aside, only single pixels do. Brightness is therefore
compared by its mean over windows, and a source that differs loses weight as by Cauchy's likelihood. It also
loses weight beside what it does not show: outlines of what hides a surface are seldom in their place.
"""

import numpy as np
from numba import njit

from nvsf_core.kernels.images.first_blend import first_blend, luma
from nvsf_core.kernels.images.window_mean import window_mean

_REACH = 4
"""Windows have so many pixels on each side of their own."""
_UNLIKE = np.float32(0.1)
"""A source whose window differs by so much has half of the weight."""
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


def source_trust(
    colour: np.ndarray, seen: np.ndarray, likeliest: np.ndarray, around: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Share of its weight, 0..1, that each colour of a pixel keeps beside the mean of the sources.

    Args:
        colour: (k, 3, d, h, w) float32 that k sources show at d depths, 0..1; any where they do not.
        seen: (k, d, h, w) bool, whether they do.
        likeliest: (h, w) int64, which of the d depths is the likeliest: the sources' mean is taken there.
        around: (3, h, w) float32 colours where no source shows anything.
        weight: (k,) float32 of the sources in the mean; 1 = of the nearest.

    Returns:
        (d k + 1, h, w) float32, depth by depth; the last is that of `around`.
    """
    target = luma(first_blend(colour, seen, likeliest, around, weight).colour)
    sources, depths = seen.shape[:2]
    trust, share = np.empty((depths * sources + 1, *target.shape), np.float32), np.empty_like(target)
    for d in range(depths):
        for k in range(sources):
            _compare(luma(colour[k, :, d]), seen[k, d], target, share, trust[d * sources + k])
    _compare(luma(around), np.ones_like(seen[0, 0]), target, share, trust[-1])
    return trust


@njit(cache=True, nogil=True)
def _compare(shown, seen, target, share, trust):  # type: ignore[no-untyped-def]
    """Write the trust in brightness (h, w) `shown`; `share` is scratch: of each window, how much is seen."""
    rows, columns = target.shape
    for r in range(rows):
        for c in range(columns):
            trust[r, c] = shown[r, c] - target[r, c] if seen[r, c] else _ZERO
            share[r, c] = _ONE if seen[r, c] else _ZERO
    window_mean(trust, _REACH)
    window_mean(share, _REACH)
    for r in range(rows):
        for c in range(columns):
            unlike = trust[r, c] / (_UNLIKE * share[r, c]) if seen[r, c] else _ZERO
            trust[r, c] = share[r, c] / (_ONE + unlike * unlike)
