"""Training scans simulated as if they were held out, and compared with what was recorded."""

import numpy as np

from nvsf_core.evidence.scene_evidence import LeftOutEvidence
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.metrics.range_and_intensity import intensity_image_metrics, range_image_metrics
from nvsf_core.recipe import EvidenceSpec
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.rendering.rendered import RenderedRays
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.ray_renderers import evidence_renderer
from nvsf_core.simulation.raydrop import rays_return
from nvsf_core.simulation.scan import RenderedSweep, SweepRays
from nvsf_core.simulation.scene_model import RayRenderer, SceneModel, SweepCorrector
from nvsf_core.simulation.sweep_simulation import fire_sweep
from nvsf_core.simulation.view_plan import recorded_sweep

SCAN_METRICS = {
    "chamfer_m2": False, "f_score": True, "range_psnr_db": True, "intensity_psnr_db": True,
    "hit_accuracy": True,
}  # fmt: skip
"""As in the protocol `lidar4d_scan`, and whether higher is better. But hit accuracy is that of the firings:
in a pano's cells false returns are hidden behind nearer ones."""
_PANO = LinearPano(reference_quirks=True)


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
    truth: tuple[np.ndarray, np.ndarray],
) -> list[float]:
    """The values of `SCAN_METRICS` of a training scan that is simulated as if it were held out.

    Args:
        render: As in `fire_left_out`.
        prior_scans: As in `fire_left_out`.
        lidar: The recording.
        number: Of the scan among the training scans.
        truth: Of `recorded_pano`.
    """
    prior = lidar.evidence.prior
    rays, rendered = fire_left_out(render, prior_scans, lidar, number)
    points_m, intensity, _ = RenderedSweep.of(rays, rendered).scan()
    shown = _PANO.project(points_m, intensity)
    found = {
        **point_cloud_metrics(_PANO.points(shown[0]), _PANO.points(truth[0])),
        **range_image_metrics(shown[0], truth[0]),
        **intensity_image_metrics(shown[1], truth[1]),
    }
    expected = np.isfinite(rendered.range_m) & rays_return(rendered.hit)
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
    model = SceneModel(lidar=render, camera=None, prior_scans=prior_scans, correct=correct)
    return fire_sweep(model, lidar, plan, time_s, leave_out_s=time_s)
