"""Rows of metrics are summed up as checks: what an infinite value says depends on whose it is."""

import math

from nvsf_core.metrics.measure import Measure
from nvsf_core.stages.runner.stage import Check
from nvsf_core.stages.scoring.rows import Ledger

_P90 = "range_abs_error_p90_m"
_COSTS = {
    "scene": "tiny", "commit": "", "seed": 0, "train_seconds": 0.0, "parameters": 0.0, "model_mb": 0.0,
    "peak_memory_mb": 0.0,
}  # fmt: skip


def finite_check(model: float, copy: float) -> Check:
    ledger = Ledger(facts={})
    for recipe, value in (("quick", model), ("copy_nearest", copy)):
        own = Ledger(facts=_COSTS | {"recipe": recipe})
        own.add({_P90: Measure(value, 100)}, protocol="raw", sensor="lidar", frame=3, render_seconds=0.0)
        ledger.take(own)
    (found,) = (one for one in ledger.output().checks if one.name == "all_metrics_of_whole_frames_are_finite")
    return found


def test_a_copy_without_an_answer_for_a_tenth_of_the_rays_is_no_fault_of_the_model() -> None:
    assert finite_check(0.1, math.inf).passed


def test_an_infinite_error_of_the_model_is_named() -> None:
    check = finite_check(math.inf, math.inf)
    assert not check.passed and check.value == 1.0
    assert f"raw {_P90}: infinite (1 times)" in check.detail
