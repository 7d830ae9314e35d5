"""Whether a place on a moving object returns: the scans that saw the object vote, each where it was then."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.rigid_path import MovingObject
from nvsf_core.evidence.raydrop.prior import DropPrior
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts
from nvsf_core.kernels.grid_hit_priors import share_of_scans
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable

_FORGOTTEN_FRAMES = 1.5
"""A scan so many frames farther away in time counts e times less: windows and edges look another way."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectHitPriors:
    """What is needed to look up where a training scan fired at a place of an object."""

    prior: DropPrior
    """Its scans are the training scans that objects are numbered by."""
    lasers: np.ndarray
    """(l,) lasers that ever returned, from the top."""
    trajectory: Trajectory
    table: LaserTable
    elevation_correction_rad: float

    def near(
        self, asked: Sequence[tuple[MovingObject, np.ndarray]], time_s: float
    ) -> tuple["NearHitPriors", ...]:
        """The votes on each object of some of its scans (k,) about a time; silent ones are not asked."""
        is_unidentified = self.prior.is_unidentified
        paths = [path for path, _ in asked]
        speaking = [scans[~is_unidentified[scans]] for _, scans in asked]
        own_s = [path.time_s[np.searchsorted(path.scan, s)] for path, s in zip(paths, speaking, strict=True)]
        # One look-up for all objects: of so few times it costs the same.
        to_sensor = invert_pose(pose_from_parts(*self.trajectory.at(np.concatenate([*own_s, np.zeros(0)]))))
        ends = np.cumsum([len(instants) for instants in own_s], dtype=np.int64)
        return tuple(
            NearHitPriors(
                self,
                scans.astype(np.int64),
                np.exp(-np.abs(instants - time_s) / (_FORGOTTEN_FRAMES * path.frame_s)),
                to_sensor[end - len(instants) : end] @ path.matrix_at(instants),
            )
            for path, scans, instants, end in zip(paths, speaking, own_s, ends, strict=True)
        )


@dataclass(frozen=True, slots=True, eq=False)
class NearHitPriors:
    """Some scans that saw an object, ready to be asked about any place on it."""

    hit_priors: ObjectHitPriors
    scans: np.ndarray
    """(k,) int64 training scans."""
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
        hit_priors, table, prior = self.hit_priors, self.hit_priors.table, self.hit_priors.prior
        found: np.ndarray = share_of_scans(
            np.ascontiguousarray(place_o, np.float64), self.object_to_sensor, self.weight,
            hit_priors.elevation_correction_rad, hit_priors.lasers.astype(np.int64), table.elevation_rad,
            table.vertical_offset_m, table.horizontal_offset_m,
            (table.phase_steps - table.firing_shift_steps) * table.step_rad, self.scans, prior.fraction,
            prior.is_hit,
        )  # fmt: skip
        return found
