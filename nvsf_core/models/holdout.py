"""Compares candidates on validation data: scans or images of the training frames that were left out.

A learned part is used only where it beats its baseline here. Test frames are never among the data. A scan is
simulated as if it were held out.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from nvsf_core._types import Scalar
from nvsf_core.evidence.scene_evidence import ALL, MOST, NEVER, LeftOutEvidence
from nvsf_core.evidence.surfels import Surfels
from nvsf_core.kernels.threads import MOST_VIEWS, in_parts
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.metrics.range_and_intensity import intensity_image_metrics, range_image_metrics
from nvsf_core.recipe.residual import EvidenceSpec
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.rendering.reproject import reproject_rays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.sensors.sweep import SweepRays
from nvsf_core.simulation.ray_renderers import evidence_renderer
from nvsf_core.simulation.scan import RenderedSweep, returns_of_sweep
from nvsf_core.simulation.scene_model import RayRenderer, SceneModel, SweepCorrector
from nvsf_core.simulation.sweep_simulation import fire_sweep
from nvsf_core.simulation.view_plan import recorded_sweep

Left = TypeVar("Left")
_LEAST_ERROR = 1e-9
"""For ratios of errors."""
_SURE = 2.0
"""Standard errors by which a mean gain must exceed zero."""
SCAN_METRICS = {
    "chamfer_m2": False, "f_score": True, "range_psnr_db": True, "intensity_psnr_db": True,
    "hit_accuracy": True,
}  # fmt: skip
"""As in the protocol `lidar4d_scan`, and whether higher is better. But hit accuracy is that of the firings:
in a pano's cells false returns are hidden behind nearer ones."""
_PANO = LinearPano(reference_quirks=True)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Mean scores of candidates on the same validation data."""

    metrics: tuple[str, ...]
    """Names, with their units: `_db` of a PSNR; else, if higher is better, a share."""
    higher_is_better: tuple[bool, ...]
    means: Mapping[str, tuple[float, ...]]
    """The means of each candidate, in the order of the metrics."""

    def of(self, candidate: str, metric: str) -> float:
        """The mean of a candidate in a metric."""
        return self.means[candidate][self.metrics.index(metric)]

    def is_better(self, candidate: str, metric: str, other: str) -> bool:
        """Whether a candidate is better than another in a metric; NaN is never better."""
        ours, theirs = self.of(candidate, metric), self.of(other, metric)
        return ours > theirs if self.higher_is_better[self.metrics.index(metric)] else ours < theirs

    def wins(self, candidate: str, other: str) -> bool:
        """Whether a candidate's errors are smaller than another's, in the geometric mean of all metrics.

        So a large gain in one metric counts for more than small losses in others. A metric in which either is
        undefined does not count; where most are, nobody wins.
        """
        gains = [math.log(self._error(other, m) / self._error(candidate, m)) for m in self.metrics]
        defined = [gain for gain in gains if not math.isnan(gain)]
        return len(defined) > len(self.metrics) // 2 and sum(defined) > 0.0

    def _error(self, candidate: str, metric: str) -> float:
        """A mean as an error, positive: of a PSNR the root mean square, of a share (0..1) what is missing."""
        value = self.of(candidate, metric)
        if metric.endswith("_db"):
            return float(10.0 ** (-value / 20.0))
        return max(1.0 - value if self.higher_is_better[self.metrics.index(metric)] else value, _LEAST_ERROR)

    def figures(self, prefixes: Mapping[str, str]) -> dict[str, Scalar]:
        """Means as metadata, under the metric's name after the candidate's prefix in `prefixes`."""
        return {
            f"{prefix}{metric}": "undefined" if np.isnan(value) else value
            for candidate, prefix in prefixes.items()
            for metric, value in zip(self.metrics, self.means[candidate], strict=True)
        }


def compare(
    metrics: Mapping[str, bool],
    validation: Iterable[Left],
    candidates: Mapping[str, Callable[[Left], Sequence[float]]],
    *,
    at_once: int = MOST_VIEWS,
) -> Comparison:
    """Score candidates on validation data and take the means.

    Args:
        metrics: For each metric (its name with its unit), whether higher is better.
        validation: At least one scan or image.
        candidates: For each name, a function that scores one of them, in the order of the metrics.
        at_once: Most that are scored at once.
    """
    kept_out = list(validation)
    # All together: threads wait for the last of them once, not once a candidate.
    work = [(score, one) for score in candidates.values() for one in kept_out]
    scores = in_parts(lambda number: work[number][0](work[number][1]), len(work), at_once)
    by_candidate = np.reshape(scores, (len(candidates), len(kept_out), len(metrics))).mean(axis=1)
    means = dict(zip(candidates, (tuple(row) for row in by_candidate.tolist()), strict=True))
    return Comparison(tuple(metrics), tuple(metrics.values()), means)


def validation_numbers(count: int, every: int, first: int) -> range:
    """Which of `count` items are for validation: every `every`-th from `first`; at least one, never all."""
    return range(min(first, count // 2), count, every)


def is_sure(gains: Sequence[float]) -> bool:
    """Whether the mean of at least two gains is above zero by more than two standard errors."""
    return bool(np.mean(gains) > _SURE * np.std(gains, ddof=1) / np.sqrt(len(gains)))


def recorded_pano(lidar: LidarRecording, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Range in metres and intensity (66, 1030) float32 of a training scan, projected as the papers do."""
    sweeps, a = lidar.sweeps, lidar.sweeps.arrays
    part = sweeps.returns_of(int(np.flatnonzero(sweeps.is_training)[number]))
    return _PANO.project(a["points_m"][part], a["intensity"][part])


def left_out_renderer(lidar: LidarRecording, left_out: LeftOutEvidence, number: int) -> RayRenderer:
    """`reproject` without the returns of a validation scan, given by its number among the training scans."""
    return evidence_renderer(
        left_out.for_rendering, lidar.moving(leave_out=number),
        most=EvidenceSpec().lidar_candidates, far_m=lidar.far_m,
    )  # fmt: skip


def score_left_out(
    render: RayRenderer,
    prior_scans: int,
    lidar: LidarRecording,
    number: int,
) -> list[float]:
    """The values of `SCAN_METRICS` of a training scan that is simulated as if it were held out."""
    prior, truth = lidar.evidence.prior, recorded_pano(lidar, number)
    rays, rendered = fire_left_out(render, prior_scans, lidar, number)
    points_m, intensity, _ = RenderedSweep.of(rays, rendered).scan()
    shown = _PANO.project(points_m, intensity)
    found = {
        **point_cloud_metrics(_PANO.points(shown[0]), _PANO.points(truth[0])),
        **range_image_metrics(shown[0], truth[0]),
        **intensity_image_metrics(shown[1], truth[1]),
    }
    expected = returns_of_sweep(rays, rendered)
    returned = prior.is_hit[number, rays.laser, prior.nearest_firing(number, rays.fraction)]
    return [*(found[name].value for name in list(SCAN_METRICS)[:-1]), float((expected == returned).mean())]


def fire_left_out(
    render: RayRenderer,
    prior_scans: int,
    lidar: LidarRecording,
    number: int,
    correct: SweepCorrector | None = None,
) -> tuple[SweepRays, RenderedRays]:
    """Simulate a training scan as if it were held out.

    Args:
        render: Without that scan's returns.
        prior_scans: Number of scans that give the hit prior.
        lidar: The recording.
        number: Of the scan among the training scans.
        correct: Corrects the rendered sweep, if any.
    """
    time_s = float(lidar.evidence.prior.time_s[number])
    plan = recorded_sweep(lidar.sweeps.table, time_s)
    model = SceneModel(lidar=render, camera=None, prior_scans=prior_scans, correct=correct, copies_unmet=True)
    return fire_sweep(model, lidar, plan, time_s, leave_out_s=time_s)


def choose_copying(lidar: LidarRecording) -> tuple[LidarRecording, dict[str, Scalar]]:
    """The recording, whose stationary scans are copied where that is better, and the scores of both.

    Combined scans have less noise; but where everything stands, the scan before is hard to beat: it repeats
    what the sensor sees again and again, whether a surface explains it or not. Compared are those validation
    scans at which the sensor rested, rendered by `reproject`; without any, scans are combined.
    """
    stationary, left_out = lidar.evidence.stationary, lidar.evidence.left_out
    if stationary is None or left_out is None:
        return lidar, {}
    numbers = np.intersect1d(left_out.validation, stationary.scan).tolist()
    if not numbers:
        return lidar, {}
    copying = replace(lidar, evidence=replace(
        lidar.evidence, stationary=replace(stationary, is_copied=np.array(True))
    ))  # fmt: skip

    def scores(recording: LidarRecording) -> Callable[[int], list[float]]:
        return lambda number: score_left_out(
            left_out_renderer(lidar, left_out, number), EvidenceSpec().votes, recording, number
        )

    found = compare(SCAN_METRICS, numbers, {"combined": scores(lidar), "copied": scores(copying)})
    chosen = copying if found.wins("copied", "combined") else lidar
    figures = found.figures({"combined": "stationary_combined_", "copied": "stationary_copied_"})
    return chosen, {"stationary_shows": "copied" if chosen is copying else "combined", **figures}


def choose_copied_share(lidar: LidarRecording) -> tuple[LidarRecording, dict[str, Scalar]]:
    """The recording with the `copied_share` that suits the validation scans best, and the scores of all.

    A ray that passes between all that was recorded leaves a hole where a surface goes on, and is right where
    it ends: that differs from drive to drive. Without validation scans, or known lasers, only what all scans
    say is copied.
    """
    left_out = lidar.evidence.left_out
    if left_out is None or len(lidar.evidence.lasers) == 0:
        return lidar, {}
    shares = {"all": ALL, "most": MOST, "never": NEVER}
    recordings = {
        name: replace(lidar, evidence=replace(lidar.evidence, copied_share=share))
        for name, share in shares.items()
    }

    def scores(recording: LidarRecording) -> Callable[[int], list[float]]:
        return lambda number: score_left_out(
            left_out_renderer(lidar, left_out, number), EvidenceSpec().votes, recording, number
        )

    found = compare(
        SCAN_METRICS, left_out.validation.tolist(), {name: scores(one) for name, one in recordings.items()}
    )
    best = "all"
    for name in ("most", "never"):
        best = name if found.wins(name, best) else best
    figures = found.figures({name: f"unmet_copied_by_{name}_" for name in shares})
    return recordings[best], {"unmet_copied_by": best, **figures}


def mean_range_error_m(
    surfels: Surfels,
    origin_m: np.ndarray,
    direction: np.ndarray,
    range_m: np.ndarray,
    *,
    far_m: float,
    worst_m: float,
) -> float:
    """Mean absolute range error in metres of surfels, rendered as `reproject` does along r recorded returns.

    Args:
        surfels: In the rays' frame.
        origin_m: (r, 3).
        direction: (r, 3) unit.
        range_m: (r,) recorded range.
        far_m: How far a ray is followed.
        worst_m: Largest error of a ray; also the error of one that meets nothing.
    """
    rendered = reproject_rays(
        surfels, origin_m, direction, np.ones(len(range_m), np.float32),
        most=EvidenceSpec().lidar_candidates, far_m=far_m,
    )  # fmt: skip
    off_m = np.abs(rendered.range_m.astype(np.float64) - range_m)
    return float(np.minimum(np.where(np.isfinite(off_m), off_m, worst_m), worst_m).mean())
