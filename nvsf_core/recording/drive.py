"""A recorded drive as models read it: scans with what they prove, images, and all poses."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.object_evidence import ObjectHitPriors
from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.recording.images import CameraRecording
from nvsf_core.recording.sweeps import LinearPanos, Sweeps
from nvsf_core.sensors.sweep import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarRecording:
    """The scans, and what the training ones prove."""

    sweeps: Sweeps
    evidence: SceneEvidence
    read_panos: Callable[[], LinearPanos] | None = None
    """The scans as the paper's panos, read when first asked for; None where nobody projected them."""

    @property
    def far_m(self) -> float:
        """How far a simulated ray is followed."""
        return float(self.sweeps.table.max_range_m)

    @property
    def object_hit_priors(self) -> ObjectHitPriors:
        """Tells how often the scans saw a place on a moving object return."""
        sweeps, evidence = self.sweeps, self.evidence
        return ObjectHitPriors(
            evidence.prior, evidence.lasers, sweeps.trajectory, sweeps.table, sweeps.elevation_correction_rad
        )

    def moving(self, *, leave_out: int | None = None) -> NearObjects | None:
        """What moves, ready to be asked for about any time, as if a training scan were held out.

        None where nothing moves.
        """
        dynamic = self.evidence.dynamic
        if dynamic is None:
            return None
        return NearObjects(dynamic.objects, self.object_hit_priors, leave_out=leave_out)


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A drive with LiDAR, cameras, or both; everything scene-local but for `scene_origin_m`."""

    lidar: LidarRecording | None
    cameras: dict[str, CameraRecording]
    trajectory: Trajectory
    """Of the LiDAR's frame, which a camera-only drive has by its calibration or as the pose frame."""
    scene_origin_m: np.ndarray
    """(3,) float64, in the world."""
    posed_frame: np.ndarray
    """(p,) int64 ascending: frames with a pose, recorded by whatever sensor."""
    posed_time_s: np.ndarray
    """(p,) float64."""
