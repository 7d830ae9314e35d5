"""What `lean` set out to reach on two CPU cores before it was built; docs/results.md compares."""

from dataclasses import dataclass

from nvsf_core.metrics.table import BASELINES


@dataclass(frozen=True, slots=True)
class Target:
    """One limit of one scene, for the mean over the held-out frames and over three seeds."""

    scene: str
    protocol: str
    metric: str
    limit: float
    at_least: bool = False
    """Else at most."""

    def is_met(self, value: float) -> bool:
        """Whether a measured value keeps the limit; a NaN does not."""
        return value >= self.limit if self.at_least else value <= self.limit


_STREET, _MOVING = "k360_street", "kitti0005_van_cyclist"
TARGETS = (
    Target(_STREET, "lidar4d_scan", "chamfer_m2", 0.031),
    Target(_STREET, "lidar4d_scan", "f_score", 0.975, at_least=True),
    Target(_STREET, "lidar4d_scan", "range_psnr_db", 29.8, at_least=True),
    Target(_STREET, "lidar4d_scan", "hit_accuracy", 0.970, at_least=True),
    Target(_STREET, "lidar4d", "chamfer_m2", 0.027),
    Target(_STREET, "lidar4d", "f_score", 0.977, at_least=True),
    Target(_STREET, "lidar4d", "range_rmse_m", 2.4),
    Target(_STREET, "lidar4d", "range_psnr_db", 30.5, at_least=True),
    Target(_STREET, "lidar4d", "range_medae_m", 0.025),
    Target(_STREET, "lidar4d", "hit_accuracy", 0.973, at_least=True),
    Target(_STREET, "lidar4d", "intensity_psnr_db", 20.5, at_least=True),
    Target(_STREET, "raw", "range_abs_error_median_m", 0.040),
    Target(_STREET, "raw", "range_abs_error_p90_m", 0.15),
    Target(_STREET, "raw", "chamfer_m2", 0.022),
    Target(_STREET, "raw", "f_score", 0.981, at_least=True),
    Target(_STREET, "raw", "hit_accuracy", 0.984, at_least=True),
    Target(_STREET, "image", "image_psnr_db", 22.0, at_least=True),
    Target(_MOVING, "lidar4d_scan", "chamfer_m2", 0.095),
    Target(_MOVING, "lidar4d_scan", "f_score", 0.950, at_least=True),
    Target(_MOVING, "lidar4d_scan", "range_psnr_db", 25.0, at_least=True),
    Target(_MOVING, "lidar4d_scan", "hit_accuracy", 0.975, at_least=True),
)

BETTER_THAN = {
    (_MOVING, "masked", "chamfer_m2"): BASELINES,
    (_MOVING, "masked", "f_score"): BASELINES,
    (_MOVING, "masked", "range_rmse_m"): BASELINES,
    (_MOVING, "masked", "hit_accuracy"): BASELINES,
    (_STREET, "image", "image_lpips_squeeze"): ("reproject", "paper_cpu"),
}
"""Scene, protocol and metric to the methods whose mean is to be worse. `paper_cpu` is a field that draws
alone (`benchmarks.lean.field_alone`)."""
COSTS = {
    "lean": {"train_seconds": 1800, "parameters": 8e6, "render_seconds": 0.6},
    "reproject": {"render_seconds": 0.2},
}
"""Method to the most that it may cost on a drive with a camera; seconds of a sweep of 64 lasers."""
SHIFTS = {"shift_1m": 1.5, "shift_3m": 2.5}
"""View of the demo to the most that its CD may be, in those of the view `between`."""

OTHER = "other_"
"""How the names of drives begin that nobody tuned on (`benchmarks.tables.other_drives`)."""
NEVER_WORSE = {"chamfer_m2": False, "f_score": True, "range_psnr_db": True}
"""Metric of `lidar4d_scan` in which a model is never worse than `copy_nearest`, to whether more is better."""
