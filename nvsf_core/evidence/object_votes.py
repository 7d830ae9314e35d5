"""Whether a place on a moving object returns: the scans that saw the object vote, each where it was then."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.drop_prior import DropPrior
from nvsf_core.evidence.moving import MovingObject
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts
from nvsf_core.kernels.grid_votes import read_grid
from nvsf_core.sensors.beam_table import turn_up
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable

_FORGOTTEN_FRAMES = 1.5
"""A scan so many frames farther away in time counts e times less: windows and edges look another way."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectVotes:
    """What is needed to look up where a training scan fired at a place of an object."""

    prior: DropPrior
    """Its scans are the training scans that objects are numbered by."""
    lasers: np.ndarray
    """(l,) lasers that ever returned, from the top."""
    trajectory: Trajectory
    table: LaserTable
    elevation_correction_rad: float

    def near(self, path: MovingObject, scans: np.ndarray, time_s: float) -> "NearVotes":
        """The votes of some of an object's `scans` (k,) about a time; silent ones are not asked."""
        scans = scans[~self.prior.is_silent[scans]]
        own_s = path.time_s[np.searchsorted(path.scan, scans)]
        rotation, position = self.trajectory.at(own_s)
        return NearVotes(
            self,
            scans,
            np.exp(-np.abs(own_s - time_s) / (_FORGOTTEN_FRAMES * path.frame_s)),
            invert_pose(pose_from_parts(rotation, position)) @ path.matrix_at(own_s),
        )

    def returned(self, point_m: np.ndarray, scan: int) -> np.ndarray:
        """Share (v,) float32 of a scan's firings at points (v, 3) of its sensor's frame that returned.

        The two lasers and two firings of each that look beside a point are weighted by how near to it
        they do.
        """
        azimuth = np.arctan2(point_m[:, 1], point_m[:, 0])
        recorded, _ = turn_up(point_m, point_m, azimuth, -self.elevation_correction_rad)
        flat_m = np.hypot(recorded[:, 0], recorded[:, 1])
        table = self.table
        found: np.ndarray = read_grid(
            azimuth, np.arctan2(recorded[:, 2], flat_m), flat_m, np.linalg.norm(recorded, axis=1),
            self.lasers.astype(np.int64), table.elevation_rad, table.vertical_offset_m,
            table.horizontal_offset_m, (table.phase_steps - table.firing_shift_steps) * table.step_rad,
            self.prior.fraction[scan][: self.prior.firings_of(scan)].astype(np.float64),
            self.prior.is_hit[scan],
        )  # fmt: skip
        return found


@dataclass(frozen=True, slots=True, eq=False)
class NearVotes:
    """Some scans that saw an object, ready to be asked about any place on it."""

    votes: ObjectVotes
    scans: np.ndarray
    """(k,) int32 training scans."""
    weight: np.ndarray
    """(k,) float64 above 0."""
    object_to_sensor: np.ndarray
    """(k, 4, 4) float64: where each scan's sensor had the object."""

    def share(self, place_o: np.ndarray) -> np.ndarray:
        """Share (v,) float32 of the scans, by weight, that returned at places (v, 3) of its own frame.

        1 where there is none to ask: what is known of the object are returns.
        """
        if len(self.scans) == 0:
            return np.ones(len(place_o), np.float32)
        total = np.zeros(len(place_o))
        for scan, weight, pose in zip(self.scans.tolist(), self.weight, self.object_to_sensor, strict=True):
            total += weight * self.votes.returned(place_o @ pose[:3, :3].T + pose[:3, 3], scan)
        return (total / self.weight.sum()).astype(np.float32)
