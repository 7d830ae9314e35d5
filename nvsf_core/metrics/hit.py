"""Errors of hits: whether each ray returns, as predicted and as recorded."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.elementwise import rmse, same_shape
from nvsf_core.metrics.measure import Measure, fault, undefined

_MOST_COLUMNS, _LEAST_COLUMNS = 2000, 125
_NAMES = ("hit_accuracy", "hit_f_score")
Side = tuple[np.ndarray, np.ndarray]
"""The returns of a scan: points (N, 3) in the sensor's frame, and their lasers (N,)."""


def hit_image_metrics(probability: np.ndarray, truth: np.ndarray) -> Mapping[str, Measure]:
    """`hit_rmse` of the probability against 0/1, `hit_accuracy` and `hit_f_score` at a threshold of 0.5.

    The F-score is that of the class "return": 0 if the two sides have no return in common, undefined if
    neither has any.

    Args:
        probability: Predicted hit probability, any shape.
        truth: Whether there was a return, bool, the same shape.

    Raises:
        ShapeError: The shapes differ, or the truth is not bool.
    """
    if truth.dtype != np.bool_:
        raise ShapeError(
            f"expected the true hits as bool, found {truth.dtype}; of a range image: range_m > 0"
        )
    error = rmse(probability, truth.astype(np.float64))
    bad = fault(probability, truth)
    if bad is not None:
        return {"hit_rmse": error} | dict.fromkeys(_NAMES, bad)
    return {"hit_rmse": error, **_agreement(probability > 0.5, truth)}


def hit_cell_metrics(
    predicted: Side,
    truth: Side,
    shape: tuple[int, int],
    *,
    region: tuple[np.ndarray, np.ndarray] | None = None,
    complement: bool = False,
) -> Mapping[str, Measure]:
    """`hit_accuracy` and `hit_f_score` on a grid of lasers and azimuths, see `hit_cells`.

    Both are undefined if a return's laser is unknown (-1) or a point is not finite.

    Args:
        predicted: The whole simulated scan.
        truth: The whole recorded scan.
        shape: Lasers and columns of the grid, see `hit_columns`.
        region: Which returns (N,), (M,) bool of either lie in a region: only the cells with one of them are
            compared; None = all cells.
        complement: True = all other cells instead.
    """
    bad = _no_cells(predicted, truth, shape)
    if bad is not None:
        return dict.fromkeys(_NAMES, bad)
    where = np.ones(shape, dtype=bool)
    if region is not None:
        of_predicted, of_truth = (
            hit_cells(points_m[chosen], laser[chosen], shape)
            for (points_m, laser), chosen in zip((predicted, truth), region, strict=True)
        )
        where = (of_predicted | of_truth) ^ complement
    if not where.any():
        return dict.fromkeys(_NAMES, undefined("no return of either side lies in the region"))
    return _agreement(hit_cells(*predicted, shape)[where], hit_cells(*truth, shape)[where])


def _no_cells(predicted: Side, truth: Side, shape: tuple[int, int]) -> Measure | None:
    """The undefined measure if returns cannot be assigned to cells; None if they can."""
    unknown = int(np.count_nonzero(truth[1] < 0) + np.count_nonzero(predicted[1] < 0))
    if unknown or shape[0] < 1:
        return undefined(f"the laser of {unknown} returns is unknown")
    for side, (points_m, laser) in (("predicted", predicted), ("true", truth)):
        if laser.size and int(laser.max()) >= shape[0]:
            return undefined(f"{side} laser {int(laser.max())}, but the sensor has {shape[0]}")
        broken = int(np.count_nonzero(~np.isfinite(points_m).all(axis=1)))
        if broken:
            return undefined(f"{broken} of {len(points_m)} {side} points are not finite")
    return None


def hit_columns(firings: int) -> int:
    """Columns of the grid of hits of a sensor with `firings` firings a rotation; 0 = unknown.

    2000, or a half, a quarter, ... of it: no firing step is wider, so an empty cell is a dropped ray.
    """
    columns = _MOST_COLUMNS
    while 0 < firings < columns and columns > _LEAST_COLUMNS:
        columns //= 2
    return columns


def hit_cells(points_m: np.ndarray, laser: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cells with a return, bool (lasers, columns), of points (N, 3); the columns divide a rotation."""
    columns = shape[1]
    x_m, y_m = points_m[:, 0].astype(np.float64), points_m[:, 1].astype(np.float64)
    share = np.mod(np.arctan2(y_m, x_m) / (2.0 * np.pi), 1.0)
    # A tiny negative azimuth wraps to exactly 1.0 in floating point.
    cell = np.minimum((share * columns).astype(np.int64), columns - 1)
    hit = np.zeros(shape, dtype=bool)
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
