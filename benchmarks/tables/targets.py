"""Targets on two CPU cores, each set before what should reach it was built; docs/results.md compares."""

from nvsf_core.metrics.table import BASELINES

_STREET, _MOVING = "k360_street", "kitti0005_van_cyclist"
TARGETS = {
    (_STREET, "lidar4d_scan"): {
        "chamfer_m2": 0.031, "f_score": 0.975, "range_psnr_db": 29.8, "hit_accuracy": 0.970,
    },
    (_STREET, "lidar4d"): {
        "chamfer_m2": 0.027, "f_score": 0.977, "range_rmse_m": 2.4, "range_psnr_db": 30.5,
        "range_medae_m": 0.025, "hit_accuracy": 0.973, "intensity_psnr_db": 20.5,
    },
    (_STREET, "raw"): {
        "range_abs_error_median_m": 0.040, "range_abs_error_p90_m": 0.15, "chamfer_m2": 0.022,
        "f_score": 0.981, "hit_accuracy": 0.984,
    },
    (_STREET, "image"): {"image_psnr_db": 22.0},
    (_MOVING, "lidar4d_scan"): {
        "chamfer_m2": 0.095, "f_score": 0.950, "range_psnr_db": 25.0, "hit_accuracy": 0.975,
    },
}  # fmt: skip
"""Scene and protocol to the limits of metrics, for means over the held-out frames and over three seeds: at
most, or at least where more is better."""
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
    "lean": {"train_seconds": 600, "parameters": 8e6, "render_seconds": 0.25, "image_seconds": 2},
    "quick": {"train_seconds": 60},
    "reproject": {"render_seconds": 0.2},
}
"""Method to the most that it may cost on a drive with a camera; seconds of a sweep of 64 lasers."""
SHIFTS = {"shift_1m": 1.5, "shift_3m": 2.0}
"""View of the demo to the most that its CD may be, in those of the view `between`."""

OTHER = "other_"
"""How the names of drives begin that nobody tuned on (`benchmarks.tables.other_drives`)."""
NEVER_WORSE = ("chamfer_m2", "f_score", "range_psnr_db")
"""Metrics of `lidar4d_scan` in which a model is never worse than `copy_nearest`."""
