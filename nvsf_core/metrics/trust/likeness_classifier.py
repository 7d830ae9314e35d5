"""Whether patches of two kinds of data differ: a small classifier, scored where it did not learn.

Features of a patch are its statistics; a logistic regression (Newton's steps, a small ridge) learns from one
half of the patches and is scored on the other, both ways. The score is the area under the ROC curve: the
chance that of two patches, one of each kind, the right one is called rendered. 0.5 = the
kinds cannot be distinguished, 1 = always.
"""

import numpy as np

from nvsf_core.errors import DataError

_NEWTON_STEPS = 8
_RIDGE = 1.0
"""Of the weights of standardised features."""
_LEAST_PATCHES = 16
"""Of each kind; fewer tell nothing."""
_SMALL = 1e-4
_GREY_SIDE = 16
_SCAN_PATCH = (8, 32)
"""Lasers and firings of a patch of a scan."""
_SCAN_BLOCK = (2, 8)


def distinguished(one: np.ndarray, other: np.ndarray) -> float:
    """Area under the ROC curve, 0.5..1, of a classifier of two sets of features; NaN for too few.

    Args:
        one: (n, f) float64, of patches in the order of their places: halves are every second patch.
        other: (m, f) of the other kind.

    Raises:
        DataError: A feature is not finite.
    """
    if min(len(one), len(other)) < _LEAST_PATCHES:
        return float("nan")
    features = np.concatenate([one, other])
    if not np.isfinite(features).all():
        raise DataError(f"patches: expected finite features, {(~np.isfinite(features)).sum()} are not")
    label = np.concatenate([np.ones(len(one)), np.zeros(len(other))])
    half = np.concatenate([np.arange(len(one)) % 2, np.arange(len(other)) % 2])
    score = np.zeros(len(label))
    for learned in (0, 1):
        on = half == learned
        centre, spread = features[on].mean(axis=0), features[on].std(axis=0) + _SMALL
        terms = _with_squares((features - centre) / spread)
        score[~on] = terms[~on] @ _fitted(terms[on], label[on])
    return max(0.5, float(np.mean([_area(score[half == h], label[half == h]) for h in (0, 1)])))


def image_features(rgb: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(n, 6) features of the 16 x 16 patches of an image: brightness, contrast, sharpness by scale, colour.

    Patches of `rgb` (H, W, 3) uint8 with pixels that are not `valid` (H, W) are left out.
    """
    value = _patches(rgb.astype(np.float64) / 255.0, (_GREY_SIDE, _GREY_SIDE))
    value = value[_patches(valid, (_GREY_SIDE, _GREY_SIDE)).all(axis=(1, 2))]
    grey = value.mean(axis=-1)
    edges = [np.log(_SMALL + _edge(_blocks(grey, side))) for side in (1, 2, 4)]
    colourful = (value.max(axis=-1) - value.min(axis=-1)).mean(axis=(1, 2))
    return np.stack([grey.mean(axis=(1, 2)), grey.std(axis=(1, 2)), *edges, colourful], axis=1)


def scan_features(range_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    """(n, 6) features of the patches (8 lasers x 32 firings) of a scan (L, F) that hold returns; 0 m = none.

    The means of blocks are compared, not single returns: the noise of ranges, which recorded scans have and
    rendered ones get where a data set is sampled, must not distinguish them.
    """
    ranges, shine = _patches(range_m, _SCAN_PATCH), _patches(intensity, _SCAN_PATCH)
    returned = ranges > 0.0
    kept = returned.any(axis=(1, 2))
    ranges, shine, returned = ranges[kept], shine[kept], returned[kept]
    share = returned.mean(axis=(1, 2))
    depth = _block_means(np.log(np.where(returned, ranges, 1.0)), returned)
    bright = _block_means(shine, returned)
    return np.stack(
        [
            share, np.nanmean(depth, axis=1), np.nanstd(depth, axis=1), np.nanmean(bright, axis=1),
            np.nanstd(bright, axis=1), np.isnan(depth).mean(axis=1),
        ],
        axis=1,
    )  # fmt: skip


def _with_squares(features: np.ndarray) -> np.ndarray:
    """(n, 1 + 2 f): a constant, the features and their squares."""
    bounded = np.clip(features, -5.0, 5.0)
    return np.concatenate([np.ones((len(bounded), 1)), bounded, np.square(bounded)], axis=1)


def _fitted(terms: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Weights (t,) of a logistic regression of labels (n,), 0 or 1; both kinds weigh the same."""
    ones = label.mean()
    weight = np.where(label > 0.5, 0.5 / ones, 0.5 / (1.0 - ones))
    ridge = _RIDGE * np.eye(terms.shape[1])
    found = np.zeros(terms.shape[1])
    for _ in range(_NEWTON_STEPS):
        chance = 1.0 / (1.0 + np.exp(-np.clip(terms @ found, -30.0, 30.0)))
        slope = terms.T @ (weight * (chance - label)) + ridge @ found
        curvature = (terms * (weight * chance * (1.0 - chance))[:, None]).T @ terms + ridge
        found -= np.linalg.solve(curvature, slope)
    return found


def _area(score: np.ndarray, label: np.ndarray) -> float:
    """Area under the ROC curve by the ranks of the scores; ties count half."""
    _, place, count = np.unique(score, return_inverse=True, return_counts=True)
    rank = (np.cumsum(count) - (count - 1) / 2.0)[place]
    ones = int(label.sum())
    zeros = len(label) - ones
    return float((rank[label > 0.5].sum() - ones * (ones + 1) / 2.0) / (ones * zeros))


def _patches(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(n, h, w, ...) patches of an image (H, W, ...), row by row; a rest at the edges is left out."""
    rows, columns = image.shape[0] // shape[0], image.shape[1] // shape[1]
    cut = image[: rows * shape[0], : columns * shape[1]]
    cut = cut.reshape(rows, shape[0], columns, shape[1], *image.shape[2:])
    return np.asarray(np.moveaxis(cut, 2, 1).reshape(rows * columns, *shape, *image.shape[2:]))


def _blocks(grey: np.ndarray, side: int) -> np.ndarray:
    """Means of side x side pixels of patches (n, s, s)."""
    count, length = len(grey), grey.shape[1] // side
    return np.asarray(grey.reshape(count, length, side, length, side).mean(axis=(2, 4)))


def _edge(grey: np.ndarray) -> np.ndarray:
    """(n,) mean absolute difference of neighbours in patches (n, s, s)."""
    down, right = (np.abs(np.diff(grey, axis=axis)).mean(axis=(1, 2)) for axis in (1, 2))
    return np.asarray(down + right)


def _block_means(values: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """(n, b) means over the returns in the blocks of patches (n, 8, 32); NaN for a block without one."""
    (high, wide), count = _SCAN_BLOCK, len(values)
    down, along = _SCAN_PATCH[0] // high, _SCAN_PATCH[1] // wide
    shape = (count, down, high, along, wide)
    total = np.where(returned, values, 0.0).reshape(shape).sum(axis=(2, 4)).reshape(count, down * along)
    returns = returned.reshape(shape).sum(axis=(2, 4)).reshape(count, down * along)
    return np.where(returns > 0, total / np.maximum(returns, 1), np.nan)
