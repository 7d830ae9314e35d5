"""The colour of a view's pixels: a weighted mean of what source images show at several depths, in numba."""

import numpy as np
from numba import njit

_AROUND = np.float32(0.12)
"""Weight of the colour around a pixel, beside the depths' probabilities, where the second nearest source is
as near as the first. More of it lowers squared errors, because it is smooth, and makes views less sharp; at
the place of a recorded image, where that one tells all, it only blurs (decision 0050)."""
_LEAST_AROUND = np.float32(0.01)
"""The least weight of it: where no source shows anything it is all there is."""
_NEARNESS_POWER = np.float32(1.5)
"""With 2 views are sharper, with 1 their errors are smaller."""
_OFFSET = np.array([0.02, 0.01, 0.01], np.float32)
"""Added to the probability of each depth, so that none is 0."""
_SHARP_POWER, _SHARP_AROUND = 3.0, 0.01
"""In a view of full sharpness the weights of what sources show have this power, and the colour around has
this share of its weight: nearly all is from the likeliest source (decision 0055)."""


def blended(
    colour: np.ndarray, seen: np.ndarray, share: np.ndarray, nearness: np.ndarray, around: np.ndarray,
    trust: np.ndarray, sharpness: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Blend colours, each by its depth's probability, a power of its source's nearness, and its trust.

    Args:
        colour: (k, 3, 3, h, w) float32 that k sources show, by channel and depth, 0..1.
        seen: (k, 3, h, w) bool, whether they show the point.
        share: (3, h, w) float32 probability of each depth, 0..1.
        nearness: (k,) float32 of the sources, 1 for the nearest.
        around: (3, h, w) float32 smooth colours without holes; they are blended in everywhere.
        trust: (3 k + 1, h, w) float32, above 0, of `source_trust`.
        sharpness: Of the view, 0..1.

    Returns:
        (3, h, w) float32, about 0..1.
    """
    second = np.sort(nearness)[-2] if len(nearness) > 1 else np.float32(0.0)
    beside = max(_LEAST_AROUND, _AROUND * second) * trust[-1]
    near, share = nearness**_NEARNESS_POWER, share + _OFFSET[:, None, None]
    if sharpness > 0.0:
        power = np.float32(_SHARP_POWER**sharpness)
        near, share, trust = near**power, share**power, trust**power
        beside *= np.float32(_SHARP_AROUND**sharpness)
    found = np.empty_like(around)
    _blend(colour, seen, share, near, around, beside, trust, found)
    return found


@njit(cache=True, nogil=True)
def _blend(colour, seen, share, near, around, beside, trust, found):  # type: ignore[no-untyped-def]
    """Write the blend (3, h, w); `near` (k,) are the sources' weights, `beside` (h, w) that of `around`."""
    sources, depths, rows, columns = seen.shape
    whole = np.empty(columns, np.float32)
    for r in range(rows):
        for c in range(columns):
            whole[c] = beside[r, c]
        for i in range(3):
            for c in range(columns):
                found[i, r, c] = whole[c] * around[i, r, c]
        for d in range(depths):
            for k in range(sources):
                for c in range(columns):
                    if seen[k, d, r, c]:
                        w = share[d, r, c] * near[k] * trust[d * sources + k, r, c]
                        whole[c] += w
                        found[0, r, c] += w * colour[k, 0, d, r, c]
                        found[1, r, c] += w * colour[k, 1, d, r, c]
                        found[2, r, c] += w * colour[k, 2, d, r, c]
        for i in range(3):
            for c in range(columns):
                found[i, r, c] /= whole[c]
