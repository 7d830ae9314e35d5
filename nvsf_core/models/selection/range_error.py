"""How far off evidence alone answers rays whose returns are known: what choices are judged by."""

import numpy as np

from nvsf_core.evidence.static.surfels import Surfels
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.rendering.reproject import reproject_rays


def mean_range_error_m(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    range_m: np.ndarray,
    *,
    far_m: float,
    worst_m: float,
) -> float:
    """Mean absolute error of the ranges that surfels answer along rays (r, 3) that returned at (r,).

    Args:
        surfels: In the rays' frame.
        origin_m: (r, 3).
        direction: (r, 3) unit.
        range_m: (r,) to the return.
        far_m: How far a ray is followed.
        worst_m: Most that a ray counts as off, and what one without an answer counts: beyond, wrong is wrong.
    """
    rendered = reproject_rays(
        surfels, origin_m, direction, np.ones(len(range_m), np.float32),
        most=EvidenceSpec().lidar_candidates, far_m=far_m,
    )  # fmt: skip
    off_m = np.abs(rendered.range_m.astype(np.float64) - range_m)
    return float(np.minimum(np.where(np.isfinite(off_m), off_m, worst_m), worst_m).mean())
