"""The smooth path that fits the motions between a moving object's clouds."""

import numpy as np

from nvsf_core.evidence.moving.path_fitting import LONGEST_FRAME_S, PairMotions, smooth_poses


def true_pairs(pose: np.ndarray) -> PairMotions:
    """The exact motions between neighbours and next but one of poses (k, 4)."""
    first = np.concatenate([np.arange(len(pose) - stride) for stride in (1, 2)])
    second = np.concatenate([np.arange(stride, len(pose)) for stride in (1, 2)])
    turn = pose[second, 3] - pose[first, 3]
    return PairMotions(
        first=first, second=second, centre_m=pose[first, :3],
        motion=np.column_stack([turn, pose[second, :3] - pose[first, :3]]),
        information=np.tile(np.diag([1e4, 4e2, 4e2, 4e2]), (len(first), 1, 1)),
        inlier_share=np.ones(len(first)), residual_m=np.full(len(first), 0.02),
    )  # fmt: skip


def test_a_car_in_a_bend_is_followed_at_two_scans_a_second() -> None:
    time_s = 0.5 * np.arange(12)
    yaw_rad = 8.0 / 15.0 * time_s  # 8 m/s, radius 15 m
    pose = np.column_stack([15.0 * np.sin(yaw_rad), 15.0 - 15.0 * np.cos(yaw_rad), 0.0 * yaw_rad, yaw_rad])
    found = smooth_poses(pose.copy(), time_s / min(0.5, LONGEST_FRAME_S), true_pairs(pose))
    assert np.abs(found[:, :2] - pose[:, :2]).max() < 0.1
