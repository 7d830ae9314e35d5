"""A recorded drive in memory: scans with their evidence, images, and all poses."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nvsf_core.evidence.moving.object_evidence import ObjectHitPriors
from nvsf_core.evidence.moving.objects import NearObjects
from nvsf_core.evidence.scene_evidence import SceneEvidence
from nvsf_core.recording.images import CameraRecording
from nvsf_core.recording.sweeps import LinearPanos, RecordedSweeps, Sweeps, recorded_sweeps
from nvsf_core.sensors.sweep import Trajectory


@dataclass(frozen=True, kw_only=True)
class LidarRecording:
    """The scans, and the evidence of the training scans."""

    sweeps: Sweeps
    evidence: SceneEvidence
    read_panos: Callable[[], LinearPanos] | None = None
    """Reads the scans as the paper's panos; None where they were not projected."""

    @property
    def far_m(self) -> float:
        """Greatest range of a simulated ray, metres."""
        return float(self.sweeps.table.max_range_m)

    @cached_property
    def scan_grids(self) -> RecordedSweeps:
        """The training scans by laser and firing, for looking points up in them."""
        return recorded_sweeps(self.sweeps, self.evidence)

    @property
    def object_hit_priors(self) -> ObjectHitPriors:
        """For looking up in which share of the scans a point on a moving object returned."""
        sweeps, evidence = self.sweeps, self.evidence
        return ObjectHitPriors(
            evidence.prior, evidence.lasers, sweeps.trajectory, sweeps.table, sweeps.elevation_correction_rad
        )

    def moving(self, *, leave_out: int | None = None) -> NearObjects | None:
        """Moving objects at any time, built without the training scan `leave_out`; None without any."""
        dynamic = self.evidence.dynamic
        if dynamic is None:
            return None
        return NearObjects(dynamic.objects, self.object_hit_priors, leave_out=leave_out)


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A drive with LiDAR, cameras, or both; all scene-local."""

    lidar: LidarRecording | None
    cameras: dict[str, CameraRecording]
    trajectory: Trajectory
    """Of the LiDAR's frame; without LiDAR, of the frame that calibration or poses give instead."""
    posed_frame: np.ndarray
    """(p,) int64 ascending: frames with a pose, whichever sensor recorded them."""
    posed_time_s: np.ndarray
    """(p,) float64: their instants."""
