"""The protocols of the metric tables: what is compared with what.

`lidar4d`: as published by LiDAR4D and NVSF. The model's pano, masked by its hits, with the recorded scan
projected to the 66x1030 pano as the papers' code does; every pixel counts, empty ones as 0.
`lidar4d_scan`: the same, with the projection of the exported scan as the prediction.
`raw`: with the recorded scan itself, 0 to 80 m on both sides: along its rays, and as a point cloud.
`image`: all pixels of the recorded image.
`masked`: only inside, or only outside, the boxes of moving objects (`foreground.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nvsf_core.metrics.hit import Side, hit_cell_metrics, hit_image_metrics
from nvsf_core.metrics.lpips import LPIPS_ALEX, Lpips, lpips_measure
from nvsf_core.metrics.measure import Measure
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.metrics.range_and_intensity import (
    clamped_intensity,
    clamped_range_m,
    intensity_image_metrics,
    range_image_metrics,
    ray_intensity_metrics,
    ray_range_metrics,
)
from nvsf_core.sensors.linear_pano import LinearPano

MAX_RANGE_M = 80.0
"""Returns beyond it are left out on both sides."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PanoImage:
    """One frame on the linear pano, all (H, W)."""

    range_m: np.ndarray
    """Range in metres, 0 = empty."""
    intensity: np.ndarray
    """Intensity 0..1, 0 where empty."""
    hit: np.ndarray
    """Probability of a return, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """The points of one sweep, as recorded or exported."""

    points_m: np.ndarray
    """(N, 3) in the sensor's frame at firing time."""
    intensity: np.ndarray
    """(N,) 0..1."""
    laser: np.ndarray
    """(N,) index of the laser, -1 = unknown."""

    @property
    def side(self) -> Side:
        """What its hits are found from."""
        return self.points_m, self.laser


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedRays:
    """Range and intensity along the rays of the recorded returns, all (R,)."""

    range_m: np.ndarray
    """Range along the ray; inf = no return."""
    intensity: np.ndarray
    """Intensity 0..1."""


def project_scan(pano: LinearPano, scan: Scan) -> PanoImage:
    """A scan projected to a pano; a filled pixel has hit probability 1.

    The protocol `lidar4d` wants a pano with `reference_quirks=True`.

    Raises:
        DataError: A point of the scan is not finite.
    """
    range_m, intensity = pano.project(scan.points_m, scan.intensity)
    return PanoImage(range_m=range_m, intensity=intensity, hit=(range_m > 0.0).astype(np.float32))


def lidar4d(
    predicted: PanoImage, truth: PanoImage, pano: LinearPano, lpips: Lpips | None
) -> Mapping[str, Measure]:
    """Metrics of the protocols `lidar4d` and `lidar4d_scan`, of one frame.

    First the prediction is masked by hit > 0.5. Point clouds are those of the panos' pixels. LPIPS takes
    ranges in metres, as the papers do; it is absent if `lpips` is None.
    """
    returned = predicted.hit > 0.5
    range_m = np.where(returned, predicted.range_m, 0.0)
    intensity = np.where(returned, predicted.intensity, 0.0)
    return {
        **point_cloud_metrics(pano.points(range_m), pano.points(truth.range_m)),
        **range_image_metrics(range_m, truth.range_m),
        "range_lpips_squeeze": lpips_measure(lpips, clamped_range_m(range_m), clamped_range_m(truth.range_m)),
        "range_lpips_alex": LPIPS_ALEX,
        **intensity_image_metrics(intensity, truth.intensity),
        "intensity_lpips_squeeze": lpips_measure(
            lpips, clamped_intensity(intensity), clamped_intensity(truth.intensity)
        ),
        "intensity_lpips_alex": LPIPS_ALEX,
        **hit_image_metrics(predicted.hit, truth.range_m > 0.0),
    }


def raw(
    predicted: Scan, rendered: RenderedRays, truth: Scan, truth_rays: RenderedRays, hit_shape: tuple[int, int]
) -> Mapping[str, Measure]:
    """Metrics of the protocol `raw`, of one frame.

    Args:
        predicted: The exported scan.
        rendered: The prediction along the recorded rays, in the order of the recorded returns.
        truth: The recorded scan.
        truth_rays: Recorded range and intensity along the same rays.
        hit_shape: Lasers and columns of the grid of hits, see `hit_columns`.
    """
    counted = (truth_rays.range_m > 0.0) & (truth_rays.range_m <= MAX_RANGE_M)
    returned = np.isfinite(rendered.range_m[counted])
    near_predicted, near_truth = near_returns(predicted), near_returns(truth)
    return {
        **ray_range_metrics(rendered.range_m[counted], truth_rays.range_m[counted]),
        **ray_intensity_metrics(rendered.intensity[counted], truth_rays.intensity[counted], returned),
        **hit_cell_metrics(near_predicted.side, near_truth.side, hit_shape),
        **point_cloud_metrics(near_predicted.points_m, near_truth.points_m),
    }


def near_returns(scan: Scan) -> Scan:
    """Returns above 0 and up to `MAX_RANGE_M` from the sensor; NaN points are kept, for metrics to report."""
    range_m = np.linalg.norm(scan.points_m.astype(np.float64), axis=1)
    keep = ~((range_m > MAX_RANGE_M) | (range_m == 0.0))
    return Scan(points_m=scan.points_m[keep], intensity=scan.intensity[keep], laser=scan.laser[keep])
