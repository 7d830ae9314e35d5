"""The box of a moving object: the smallest one around its returns, along its way."""

import numpy as np

from nvsf_core.evidence.moving.object_evidence import ObjectEvidence
from nvsf_core.geometry.se3 import rotation_of

_STEP_DEG = 1.0
_WITHIN_PERCENT = (0.5, 99.5)
"""Returns beyond these percentiles along an axis are mistakes in range or of the object's outline."""
_LEAST_SIDE_M = 0.1


def boxes_on_way(one: ObjectEvidence) -> np.ndarray:
    """(k, 4, 4) from the unit cube, +-0.5, to the scene-local frame, metres, at each time of its path."""
    path = one.path
    away_m = path.pose[-1, :3] - path.pose[0, :3]
    ahead = path.turn_to_object(away_m[None], path.pose[:1, 3])[0, :2]
    boxes: np.ndarray = path.matrix_at(path.time_s) @ smallest_box(one.rays.point_m(one.rays.is_hit), ahead)
    return boxes


def smallest_box(point_m: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """The upright box of least area, seen from above, around points.

    Args:
        point_m: (n, 3) metres, z up; n >= 1.
        ahead: (2,) direction of travel, x and y, of any length: the box's x axis is its axis nearest to it.

    Returns:
        (4, 4) from the unit cube, +-0.5, to the points' frame, metres; no side is shorter than 10 cm.
    """

    def area_m2(yaw_deg: float) -> float:
        low, high = np.percentile(
            point_m[:, :2] @ rotation_of(yaw_deg, 0.0, 0.0)[:2, :2], _WITHIN_PERCENT, axis=0
        )
        return float(np.prod(high - low))

    # One direction at a time: a lorry has a million returns.
    best_deg = min(np.arange(0.0, 90.0, _STEP_DEG).tolist(), key=area_m2)
    towards_deg = float(np.rad2deg(np.arctan2(ahead[1], ahead[0])))
    axes = rotation_of(best_deg + 90.0 * round((towards_deg - best_deg) / 90.0), 0.0, 0.0)
    low_m, high_m = np.percentile(point_m @ axes, _WITHIN_PERCENT, axis=0)
    box = np.eye(4)
    box[:3, :3] = axes * np.maximum(high_m - low_m, _LEAST_SIDE_M)
    box[:3, 3] = axes @ (0.5 * (low_m + high_m))
    return box
