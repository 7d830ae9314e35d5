"""A demo drive of a LiDAR alone in the plain format, recorded by a sensor of any clock."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nvsf_core.demo.lidar import simulate_scan
from nvsf_core.demo.motion import FRAME_PERIOD_S
from nvsf_core.demo.world import DemoWorld
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.plain.layout import PlainLayout
from nvsf_core.drives.plain.writer import write_description, write_plain_scan, write_poses
from nvsf_core.sensors.sweep_clock import SweepClock


def write_clocked_drive(
    root: Path,
    clock_of: Callable[[int], SweepClock],
    *,
    frames: int,
    test: tuple[int, ...],
    lasers: np.ndarray,
    firings: int,
) -> SceneEntry:
    """Write the drive below `root`, with rings and times of all returns.

    Args:
        root: A new folder.
        clock_of: Clock of the scan of a frame.
        frames: Number of frames.
        test: Held-out ones.
        lasers: (L,) rows of the HDL-64E's table.
        firings: Firings of each laser in a sweep.
    """
    layout, world = PlainLayout(root), DemoWorld()
    write_description(layout, "HDL-64E")
    moments_s = np.arange(frames) * FRAME_PERIOD_S
    write_poses(layout, range(frames), moments_s.tolist(), list(world.lidar_to_world(moments_s)))
    for frame in range(frames):
        scan = simulate_scan(world, frame, lasers, firings, clock_of(frame))
        rows = np.concatenate([scan.points_m, scan.intensity[:, None]], axis=1)
        offset_s = scan.time_s - moments_s[frame]
        write_plain_scan(layout, frame, Scan(rows, 0, ring=lasers[scan.laser], offset_s=offset_s))
    return SceneEntry(
        name="clocked", root=root, sequence="there", kind="plain", first_frame=0, last_frame=frames - 1,
        test_frames=test,
    )  # fmt: skip
