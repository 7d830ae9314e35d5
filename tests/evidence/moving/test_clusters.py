"""Clusters of returns that probably move."""

import numpy as np
import pytest

from nvsf_core.evidence.moving.detection import cluster_scan
from nvsf_core.evidence.moving.visibility import SEED, AboveGround, TimedReturns
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E


@pytest.mark.parametrize(("length_m", "clusters"), [(1.0, 1), (4.5, 1), (16.5, 1), (40.0, 0)])
def test_vehicles_up_to_a_lorry_with_trailer_are_clusters_and_walls_are_not(
    length_m: float, clusters: int
) -> None:
    along, up = np.meshgrid(np.arange(-length_m / 2.0, length_m / 2.0, 0.1), np.arange(-1.0, 1.0, 0.2))
    side = np.stack([along.ravel(), np.full(along.size, 8.0), up.ravel()], axis=1).astype(np.float32)
    count = len(side)
    returns = TimedReturns(
        point_m=side, recorded_m=side, laser=np.zeros(count, np.int16), is_own_vehicle=np.zeros(count, bool),
        time_s=np.zeros(count), offsets=np.array([0, count]), scan_time_s=np.zeros(1),
        trajectory=Trajectory(np.zeros(1), np.eye(4)[None], np.eye(4)), period_s=0.0, table=HDL_64E,
        elevation_correction_rad=0.0,
    )  # fmt: skip
    above = AboveGround(np.arange(count), np.full(count, SEED, np.int8), np.array([0, count]))
    range_m = np.linalg.norm(side, axis=1)
    assert len(cluster_scan(0, returns, above, range_m, 0.007)) == clusters
