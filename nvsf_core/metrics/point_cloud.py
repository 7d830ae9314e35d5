"""Distances between point clouds."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from nvsf_core.metrics.measure import Measure, fault, undefined

F_THRESHOLD_M2 = 0.05
"""A point is matched when its squared distance to the other cloud is below this (radius 0.2236 m)."""


def point_cloud_metrics(predicted_m: np.ndarray, truth_m: np.ndarray) -> Mapping[str, Measure]:
    """Squared Chamfer distance and F-score of two clouds.

    `chamfer_m2` = mean d^2(predicted to truth) + mean d^2(truth to predicted), in m^2, nearest
    neighbours in float64. `f_score` = harmonic mean of precision (share of the prediction with
    d^2 < 0.05 m^2) and recall (share of the truth), 0 where both are 0.
    An empty cloud has no Chamfer distance; facing a cloud with points its F-score is 0.

    Args:
        predicted_m: Points (N, 3) in metres, in the frame of the truth.
        truth_m: Points (M, 3) in metres.
    """
    n_points = len(predicted_m) + len(truth_m)
    if len(predicted_m) == 0 or len(truth_m) == 0:
        empty = [name for name, cloud in (("predicted", predicted_m), ("true", truth_m)) if len(cloud) == 0]
        missing = undefined(f"no points in the {' and the '.join(empty)} cloud", n_points)
        return {"chamfer_m2": missing, "f_score": missing if len(empty) == 2 else Measure(0.0, n_points)}
    bad = fault(predicted_m, truth_m)
    if bad is not None:
        return {"chamfer_m2": bad, "f_score": bad}
    to_truth_m2 = _nearest_m2(predicted_m, truth_m)
    to_predicted_m2 = _nearest_m2(truth_m, predicted_m)
    precision = float(np.mean(to_truth_m2 < F_THRESHOLD_M2))
    recall = float(np.mean(to_predicted_m2 < F_THRESHOLD_M2))
    both = precision + recall
    return {
        "chamfer_m2": Measure(float(to_truth_m2.mean() + to_predicted_m2.mean()), n_points),
        "f_score": Measure(2.0 * precision * recall / both if both > 0.0 else 0.0, n_points),
    }


def _nearest_m2(from_m: np.ndarray, to_m: np.ndarray) -> np.ndarray:
    """Squared distance of each point of one cloud to the nearest of the other, (N,) float64."""
    distance_m, _ = cKDTree(to_m.astype(np.float64)).query(from_m.astype(np.float64))
    squared: np.ndarray = np.square(distance_m)
    return squared
