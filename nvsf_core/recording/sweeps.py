"""All scans of a drive in memory: each return as a ray, and which scans are for training."""

from dataclasses import dataclass

import numpy as np

from nvsf_core.evidence.moving.timed_returns import TimedReturns
from nvsf_core.sensors.bonnet import Bonnet
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import LaserTable


@dataclass(frozen=True, slots=True)
class Sweeps:
    """The n scans of a drive as the stage `sweeps` publishes them, and which are for training."""

    arrays: dict[str, np.ndarray]
    is_training: np.ndarray
    """(n,) bool."""
    trajectory: Trajectory
    """All recorded poses, held-out frames' too: views of these frames are requested by pose."""
    period_s: float
    """Seconds of one sweep; 0 where the scene is not ego-motion compensated."""
    table: LaserTable
    elevation_correction_rad: float
    """Angle by which rays were turned up."""

    def returns_of(self, scan: int) -> slice:
        """Slice of a scan's returns in the flat arrays."""
        return slice(int(self.arrays["offsets"][scan]), int(self.arrays["offsets"][scan + 1]))

    def is_of_world(self, chosen: slice = slice(None)) -> np.ndarray:
        """(m,) bool: whether chosen returns show the world, within the sensor's range.

        This is the only place that excludes the own vehicle, and what its bonnet mirrors.
        """
        a = self.arrays
        own = a["is_own_vehicle"][chosen] | a["is_mirrored"][chosen]
        world: np.ndarray = ~own & (a["range_m"][chosen] < self.table.max_range_m)
        return world

    def even_intensity(self, chosen: slice | np.ndarray) -> np.ndarray:
        """(m,) float32 intensity of chosen returns, divided by their lasers' gains."""
        laser = self.arrays["laser"][chosen]
        gain = np.where(laser >= 0, self.table.intensity_gain[laser], 1.0)
        return (self.arrays["intensity"][chosen] / gain).astype(np.float32)

    @property
    def bonnet(self) -> Bonnet | None:
        """The recording car's bonnet; None where it mirrored nothing."""
        shape = self.arrays.get("bonnet_shape")
        return None if shape is None else Bonnet(shape)

    @property
    def count(self) -> int:
        """Number of scans."""
        return len(self.arrays["frame"])


@dataclass(frozen=True, slots=True, eq=False)
class LinearPanos:
    """The scans as range images on the paper's linear grid, as the stage `pano` publishes them."""

    frame: np.ndarray
    """(n,) int64 ascending."""
    range_m: np.ndarray
    """(n, 66, 1030) float32 metres, 0 = no return."""
    intensity: np.ndarray
    """(n, 66, 1030) float32."""


def training_returns(sweeps: Sweeps) -> TimedReturns:
    """The training scans' returns, own vehicle included, for finding moving objects."""
    a, lengths = sweeps.arrays, np.diff(sweeps.arrays["offsets"])
    kept = np.repeat(sweeps.is_training, lengths)
    lag_s = a["sweep_fraction"][kept].astype(np.float64) * sweeps.period_s
    return TimedReturns(
        point_m=a["origin_m"][kept] + a["direction"][kept] * a["range_m"][kept, None],
        recorded_m=a["points_m"][kept],
        laser=a["laser"][kept],
        is_own_vehicle=a["is_own_vehicle"][kept] | a["is_mirrored"][kept],
        time_s=np.repeat(a["time_s"], lengths)[kept] + lag_s,
        offsets=np.concatenate([[0], np.cumsum(lengths[sweeps.is_training])]),
        scan_time_s=a["time_s"][sweeps.is_training],
        trajectory=sweeps.trajectory,
        period_s=sweeps.period_s,
        table=sweeps.table,
        elevation_correction_rad=sweeps.elevation_correction_rad,
    )
