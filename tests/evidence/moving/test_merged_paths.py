"""Rows of one car that were tracked apart are one object; what only drives beside or behind it is not."""

import numpy as np
import pytest

from nvsf_core.evidence.moving.merged_paths import merge_paths
from nvsf_core.evidence.moving.path_fitting import Path
from nvsf_core.evidence.moving.visibility import TimedReturns
from nvsf_core.sensors.sweep import Trajectory
from nvsf_core.sensors.tables import HDL_64E

SCANS, FRAME_S = 8, 0.1
PART_RETURNS = 60


def part_of_car(start_m: tuple[float, float, float], speed_m_s: float) -> np.ndarray:
    """(n, k, 3) metres: k returns of a car's side and front at one height, in n scans."""
    along = np.column_stack([np.linspace(-2.0, 2.0, 40), np.full(40, -0.9), np.zeros(40)])
    across = np.column_stack([np.full(20, 2.0), np.linspace(-0.9, 0.9, 20), np.zeros(20)])
    driven_m = speed_m_s * FRAME_S * np.arange(SCANS)
    return np.concatenate([along, across]) + start_m + driven_m[:, None, None] * (1.0, 0.0, 0.0)


def tracked(*parts_m: np.ndarray) -> tuple[list[Path], TimedReturns]:
    """The paths of some parts, and the returns, scan by scan and in a scan part by part."""
    points = np.concatenate([np.concatenate([part[scan] for part in parts_m]) for scan in range(SCANS)])
    instants, a_scan = np.arange(SCANS) * FRAME_S, len(parts_m) * PART_RETURNS
    returns = TimedReturns(
        point_m=points.astype(np.float32), recorded_m=points.astype(np.float32),
        laser=np.zeros(len(points), np.int16), is_own_vehicle=np.zeros(len(points), bool),
        time_s=np.repeat(instants, a_scan), offsets=a_scan * np.arange(SCANS + 1), scan_time_s=instants,
        trajectory=Trajectory(instants, np.tile(np.eye(4), (SCANS, 1, 1)), np.eye(4)), period_s=0.0,
        table=HDL_64E, elevation_correction_rad=0.0,
    )  # fmt: skip
    paths = []
    for number, part in enumerate(parts_m):
        first = number * PART_RETURNS + a_scan * np.arange(SCANS)
        pose = np.column_stack([part.mean(axis=1), np.zeros(SCANS)])
        members = [np.arange(one, one + PART_RETURNS) for one in first]
        paths.append(Path(list(range(SCANS)), members, instants.copy(), pose))
    return paths, returns


CAR = part_of_car((0.0, 0.0, 0.4), 8.0)


def test_rows_of_one_car_become_one_path_with_all_returns() -> None:
    paths, returns = tracked(CAR, part_of_car((0.1, 0.0, 1.3), 8.0))
    (merged,) = merge_paths(paths, returns)
    assert [len(members) for members in merged.members] == [2 * PART_RETURNS] * SCANS
    assert np.abs(np.diff(merged.pose[:, 0]) - 0.8).max() < 0.02


def test_scans_that_only_one_of_the_parts_has_are_kept() -> None:
    paths, returns = tracked(CAR, part_of_car((0.1, 0.0, 1.3), 8.0))
    upper = paths[1]
    paths[1] = Path(upper.scan[2:], upper.members[2:], upper.time_s[2:], upper.pose[2:])
    paths[0] = Path(list(range(SCANS - 1)), paths[0].members[:-1], paths[0].time_s[:-1], paths[0].pose[:-1])
    (merged,) = merge_paths(paths, returns)
    assert merged.scan == list(range(SCANS))
    assert np.abs(np.diff(merged.pose[:, 0]) - 0.8).max() < 0.02


@pytest.mark.parametrize(
    ("start_m", "speed_m_s"), [((-7.0, 0.0, 0.4), 8.0), ((0.0, -3.0, 0.4), 8.0), ((0.0, 0.0, 1.3), 12.0)]
)
def test_cars_behind_and_beside_and_faster_ones_keep_their_own_paths(start_m, speed_m_s: float) -> None:
    paths, returns = tracked(CAR, part_of_car(start_m, speed_m_s))
    assert len(merge_paths(paths, returns)) == 2
