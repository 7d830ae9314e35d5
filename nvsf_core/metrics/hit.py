"""Errors of hits: whether each ray returns, as predicted and as recorded."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.metrics.elementwise import rmse, same_shape
from nvsf_core.metrics.measure import Measure, fault, undefined

N_CELLS = 2000
"""Azimuth cells of a sweep, 0.18 degrees each. No firing step is wider: an empty cell is a dropped ray."""
_NAMES = ("hit_accuracy", "hit_f_score")


def hit_image_metrics(probability: np.ndarray, truth: np.ndarray) -> Mapping[str, Measure]:
    """`hit_rmse` of the probability against 0/1, `hit_accuracy` and `hit_f_score` at a threshold of 0.5.

    The F-score is that of the class "return": 0 if the two sides have no return in common, undefined if
    neither has any.

    Args:
        probability: Predicted hit probability, any shape.
        truth: Whether there was a return, bool, the same shape.
    """
    error = rmse(probability, truth.astype(np.float64))
    bad = fault(probability, truth)
    if bad is not None:
        return {"hit_rmse": error} | dict.fromkeys(_NAMES, bad)
    return {"hit_rmse": error, **_agreement(probability > 0.5, truth)}


def hit_cell_metrics(
    predicted_m: np.ndarray,
    predicted_laser: np.ndarray,
    truth_m: np.ndarray,
    truth_laser: np.ndarray,
    n_lasers: int,
) -> Mapping[str, Measure]:
    """`hit_accuracy` and `hit_f_score` on a grid of n_lasers x 2000 cells, see `hit_cells`.

    Both are undefined if a return's laser is unknown (-1) or a point is not finite.

    Args:
        predicted_m: (N, 3) points of the simulated scan, sensor frame.
        predicted_laser: (N,) their lasers.
        truth_m: (M, 3) points of the recorded scan, sensor frame.
        truth_laser: (M,) their lasers.
        n_lasers: Number of the sensor's lasers.
    """
    nowhere = (np.zeros(len(predicted_m), dtype=bool), np.zeros(len(truth_m), dtype=bool))
    sides = (predicted_m, predicted_laser, truth_m, truth_laser)
    return hit_region_metrics(*sides, n_lasers, *nowhere, complement=True)


# Wide: the columns of two scans, and which of their rows belong to the region.
def hit_region_metrics(
    predicted_m: np.ndarray,
    predicted_laser: np.ndarray,
    truth_m: np.ndarray,
    truth_laser: np.ndarray,
    n_lasers: int,
    predicted_in: np.ndarray,
    truth_in: np.ndarray,
    *,
    complement: bool,
) -> Mapping[str, Measure]:
    """`hit_cell_metrics` on the cells with a return of a region, or on all others.

    Args:
        predicted_m: (N, 3) points of the whole simulated scan, sensor frame.
        predicted_laser: (N,) their lasers.
        truth_m: (M, 3) points of the whole recorded scan, sensor frame.
        truth_laser: (M,) their lasers.
        n_lasers: Number of the sensor's lasers.
        predicted_in: (N,) bool, simulated returns in the region.
        truth_in: (M,) bool, recorded returns in the region.
        complement: False = cells with a return of the region on either side; True = all other cells.
    """
    bad = _no_cells(predicted_m, predicted_laser, truth_m, truth_laser, n_lasers)
    if bad is not None:
        return dict.fromkeys(_NAMES, bad)
    filled = hit_cells(predicted_m[predicted_in], predicted_laser[predicted_in], n_lasers)
    filled |= hit_cells(truth_m[truth_in], truth_laser[truth_in], n_lasers)
    where = ~filled if complement else filled
    if not where.any():
        return dict.fromkeys(_NAMES, undefined("no return of either side lies in the region"))
    return _agreement(
        hit_cells(predicted_m, predicted_laser, n_lasers)[where],
        hit_cells(truth_m, truth_laser, n_lasers)[where],
    )


def _no_cells(
    predicted_m: np.ndarray,
    predicted_laser: np.ndarray,
    truth_m: np.ndarray,
    truth_laser: np.ndarray,
    n_lasers: int,
) -> Measure | None:
    """The undefined measure if returns cannot be assigned to cells; None if they can."""
    unknown = int(np.count_nonzero(truth_laser < 0) + np.count_nonzero(predicted_laser < 0))
    if unknown or n_lasers < 1:
        return undefined(f"the laser of {unknown} returns is unknown")
    sides = (("predicted", predicted_m, predicted_laser), ("true", truth_m, truth_laser))
    for side, points_m, laser in sides:
        if laser.size and int(laser.max()) >= n_lasers:
            return undefined(f"{side} laser {int(laser.max())}, but the sensor has {n_lasers}")
        broken = int(np.count_nonzero(~np.isfinite(points_m).all(axis=1)))
        if broken:
            return undefined(f"{broken} of {len(points_m)} {side} points are not finite")
    return None


def hit_cells(points_m: np.ndarray, laser: np.ndarray, n_lasers: int) -> np.ndarray:
    """Cells with at least one return, (n_lasers, 2000) bool.

    Args:
        points_m: (N, 3) sensor frame; the column is floor(azimuth / 0.18 degrees).
        laser: (N,) integer, the row.
        n_lasers: Number of rows.
    """
    x_m, y_m = points_m[:, 0].astype(np.float64), points_m[:, 1].astype(np.float64)
    share = np.mod(np.arctan2(y_m, x_m) / (2.0 * np.pi), 1.0)
    # A tiny negative azimuth wraps to exactly 1.0 in floating point.
    cell = np.minimum((share * N_CELLS).astype(np.int64), N_CELLS - 1)
    hit = np.zeros((n_lasers, N_CELLS), dtype=bool)
    hit[laser.astype(np.int64), cell] = True
    return hit


def _agreement(predicted: np.ndarray, truth: np.ndarray) -> dict[str, Measure]:
    same_shape(predicted, truth)
    true_positive = int(np.count_nonzero(predicted & truth))
    claimed = int(np.count_nonzero(predicted)) + int(np.count_nonzero(truth))
    f_score = (
        Measure(2.0 * true_positive / claimed, truth.size)
        if claimed
        else undefined("neither side has a return", truth.size)
    )
    return {"hit_accuracy": Measure(float(np.mean(predicted == truth)), truth.size), "hit_f_score": f_score}
