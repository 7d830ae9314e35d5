"""Checks of a trained model: its weights, its loss curve, and a training scan that it renders."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nvsf_core.metrics.norms import intensity_spread, spread_distance
from nvsf_core.recording.drive import Recording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.simulation.scan import returns_of_sweep
from nvsf_core.simulation.scene_model import SceneModel
from nvsf_core.simulation.sweep_simulation import fire_sweep
from nvsf_core.simulation.view_plan import recorded_sweep
from nvsf_core.stages.checks.declared import (
    LOSS,
    RAYS_IN_LIMITS,
    TRAINED_HIT_RATE,
    TRAINED_INTENSITY,
    WEIGHTS,
)
from nvsf_core.stages.checks.norms import (
    LEVER,
    NO_NORMS,
    check_likeness,
    norms_of,
)
from nvsf_core.stages.runner.stage import Check

_OF_RENDERING = (RAYS_IN_LIMITS, TRAINED_HIT_RATE, TRAINED_INTENSITY)
_FIFTH = 5
_FEWEST = 5
_NORMAL_MAD, _MEDIAN_ERROR = 1.4826, 1.2533
"""For a normal distribution: standard deviation over median absolute deviation, and standard error of the
median over that of the mean."""
_MOST_LASERS = 8


def check_weights(tensors: Mapping[str, Tensor]) -> Check:
    """Check `WEIGHTS`: the share of weights that are not finite."""
    broken = {name: int((~torch.isfinite(value)).sum()) for name, value in tensors.items()}
    total = sum(value.numel() for value in tensors.values())
    named = ", ".join(f"{count} in {name}" for name, count in broken.items() if count)
    detail = f"{total:,} numbers in {len(tensors)} tensors: " + (f"not finite {named}" if named else "finite")
    return WEIGHTS.outcome(sum(broken.values()) / max(1, total), 0.0, detail)


def check_loss(curves: Mapping[str, Sequence[Mapping[str, float]]]) -> Check:
    """Check `LOSS` of the curve of each part of the model; a curve of one record is not checked."""
    ends = {part: _ends([row["loss"] for row in curve]) for part, curve in curves.items() if len(curve) > 1}
    if not ends:
        return LOSS.not_run("no part was trained for long enough to tell")
    detail = ", ".join(
        f"{part} {first:.4f} to {last:.4f} ± {error:.4f}" for part, (first, last, error) in ends.items()
    )
    worst = max((last - 2.0 * error) / max(first, 1e-12) for first, last, error in ends.values())
    return LOSS.outcome(worst, 1.0, detail)


def _ends(losses: Sequence[float]) -> tuple[float, float, float]:
    """Medians of a curve's first and last fifth, and the standard error of their difference.

    Of a short curve its first and last five records, or halves: one record alone has no spread.
    """
    count = max(1, len(losses) // _FIFTH, min(_FEWEST, len(losses) // 2))
    parts = np.array([losses[:count], losses[-count:]])
    medians = np.median(parts, axis=1)
    spread = _NORMAL_MAD * np.median(np.abs(parts - medians[:, None]), axis=1)
    return float(medians[0]), float(medians[1]), float(_MEDIAN_ERROR * np.hypot(*spread) / math.sqrt(count))


def check_rendering(model: SceneModel, recording: Recording) -> list[Check]:
    """Render some lasers of the middle training scan and compare them with the recorded ones.

    Returns:
        Checks of `RAYS_IN_LIMITS`, `TRAINED_HIT_RATE` and `TRAINED_INTENSITY`; "not run" without a LiDAR.
    """
    if recording.lidar is None or model.lidar is None:
        return [named.not_run("drive or model has no LiDAR") for named in _OF_RENDERING]
    sweeps, evidence = recording.lidar.sweeps, recording.lidar.evidence
    norms = norms_of(sweeps.arrays, sweeps.is_training)
    if norms is None:
        return [named.not_run(NO_NORMS) for named in _OF_RENDERING]
    middle = len(norms.time_s) // 2
    time_s = float(norms.time_s[middle])
    scan = int(np.abs(sweeps.arrays["time_s"] - time_s).argmin())
    # A few lasers represent the whole scan, in a tenth of the time.
    lasers = evidence.lasers[np.unique(np.linspace(0, len(evidence.lasers) - 1, _MOST_LASERS).astype(int))]
    rays, rendered = fire_sweep(
        replace(model, correct=None),
        replace(recording.lidar, evidence=replace(evidence, lasers=lasers)),
        recorded_sweep(sweeps.table, time_s), time_s,
        leave_out_s=time_s if len(evidence.prior.time_s) > 1 else None,
    )  # fmt: skip
    returned = returns_of_sweep(rays, rendered)
    place = f"training frame {int(sweeps.arrays['frame'][scan])}"
    part = sweeps.returns_of(scan)
    recorded = sweeps.arrays["intensity"][part][np.isin(sweeps.arrays["laser"][part], lasers)]
    rate = float(returned.mean()) - len(recorded) / (len(lasers) * float(norms.firings[middle]))
    spreads = []
    intensity = np.clip(rendered.intensity[returned], 0.0, 1.0)
    if len(recorded) and len(intensity) and np.isfinite(intensity).all():
        apart = spread_distance(intensity_spread(intensity), intensity_spread(recorded))
        spreads = [(apart, place)]
    return [
        _within_limits(rendered, recording.lidar.far_m * LEVER, place),
        *check_likeness(TRAINED_HIT_RATE, TRAINED_INTENSITY, [(rate, place)], spreads, norms),
    ]


def _within_limits(rendered: RenderedRays, far_m: float, place: str) -> Check:
    """Check `RAYS_IN_LIMITS`. Rays with an infinite range have no return, so their values are not used."""
    unanswered = np.isposinf(rendered.range_m)
    columns = {
        "range": (rendered.range_m >= 0.0) & (rendered.range_m <= far_m),
        "hit probability": _is_share(rendered.hit),
        "intensity": _is_share(rendered.intensity),
    }
    wrong = {name: int(np.count_nonzero(~(sound | unanswered))) for name, sound in columns.items()}
    named = ", ".join(f"{count} by {name}" for name, count in wrong.items() if count) or "none"
    share = max(wrong.values()) / max(1, len(rendered.range_m))
    return RAYS_IN_LIMITS.outcome(
        share, 0.0, f"{place}, {len(rendered.range_m):,} rays, out of limits: {named}"
    )


def _is_share(values: np.ndarray) -> np.ndarray:
    sound: np.ndarray = (values >= -1e-6) & (values <= 1.0 + 1e-6)
    return sound
