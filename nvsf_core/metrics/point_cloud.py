"""Chamfer distance and F-score of point clouds."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.measure import Measure, fault, undefined

F_THRESHOLD_M2 = 0.05
"""A point is matched if its squared distance to the other cloud is below this (0.2236 m squared)."""


def point_cloud_metrics(predicted_m: np.ndarray, truth_m: np.ndarray) -> Mapping[str, Measure]:
    """Squared Chamfer distance and F-score of two clouds.

    `chamfer_m2` = mean d^2(predicted to truth) + mean d^2(truth to predicted), in m^2, of nearest
    neighbours in float64. `f_score` = harmonic mean of precision (share of the predicted points with
    d^2 < 0.05 m^2) and recall (the same of the true points), 0 if both are 0. With an empty cloud the Chamfer
    distance is undefined; the F-score is 0, or undefined if both clouds are empty.

    Args:
        predicted_m: (N, 3), in the frame of the truth.
        truth_m: (M, 3).

    Raises:
        ShapeError: A cloud has another shape.
    """
    everywhere = np.ones(len(predicted_m), bool), np.ones(len(truth_m), bool)
    return point_cloud_part_metrics(predicted_m, truth_m, *everywhere)


def point_cloud_part_metrics(
    predicted_m: np.ndarray, truth_m: np.ndarray, in_predicted: np.ndarray, in_truth: np.ndarray
) -> Mapping[str, Measure]:
    """`point_cloud_metrics` of a part (N,), (M,) bool of two clouds (N, 3), (M, 3).

    Neighbours are sought in the whole other cloud.

    Raises:
        ShapeError: A cloud has another shape.
    """
    for name, cloud_m in (("predicted", predicted_m), ("true", truth_m)):
        if cloud_m.ndim != 2 or cloud_m.shape[1] != 3:
            raise ShapeError(f"expected the {name} cloud as (N, 3) x, y, z in metres, found {cloud_m.shape}")
    sizes = int(np.count_nonzero(in_predicted)), int(np.count_nonzero(in_truth))
    n_points = sum(sizes)
    if 0 in sizes:
        empty = [name for name, size in zip(("predicted", "true"), sizes, strict=True) if size == 0]
        missing = undefined(f"no points in the {' and the '.join(empty)} cloud", n_points)
        return {"chamfer_m2": missing, "f_score": missing if len(empty) == 2 else Measure(0.0, n_points)}
    bad = fault(predicted_m, truth_m)
    if bad is not None:
        return {"chamfer_m2": bad, "f_score": bad}
    to_truth_m2 = _nearest_m2(predicted_m[in_predicted], truth_m)
    to_predicted_m2 = _nearest_m2(truth_m[in_truth], predicted_m)
    precision = float(np.mean(to_truth_m2 < F_THRESHOLD_M2))
    recall = float(np.mean(to_predicted_m2 < F_THRESHOLD_M2))
    both = precision + recall
    return {
        "chamfer_m2": Measure(float(to_truth_m2.mean() + to_predicted_m2.mean()), n_points),
        "f_score": Measure(2.0 * precision * recall / both if both > 0.0 else 0.0, n_points),
    }


def _nearest_m2(from_m: np.ndarray, to_m: np.ndarray) -> np.ndarray:
    """Squared distance (N,) float64 of each point of one cloud to the nearest of the other."""
    distance_m, _ = cKDTree(to_m.astype(np.float64)).query(from_m.astype(np.float64))
    return np.square(distance_m)
