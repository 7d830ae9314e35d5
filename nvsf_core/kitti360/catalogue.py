"""The scene catalogue: which drives there are and which synthetic views are asked for."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEntry:
    """A synthetic data set that is asked for: `[[view]]` of a catalogue."""

    name: str
    """Name of the view; its folder and its `split` in metric tables."""
    scenes: tuple[str, ...] | None = None
    """Scenes that it is asked of; None = all."""
    sensor: str | None = None
    """Name of a sensor table (`HDL-64E`, `VLP-16`, `OS1-128`); None = the recorded one."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Forward, left, up, in the vehicle's (LiDAR's) frame."""
    yaw_deg: float = 0.0
    """Turn to the left about the LiDAR's z axis."""
    frames: str | tuple[float, ...] = "all"
    """`all`, frame numbers, or (with `times_s`) nothing."""
    times_s: tuple[float, ...] | None = None
    """Times in seconds of the drive, between frames; None = use `frames`."""
    exports: tuple[str, ...] = ("bin", "ply")
    """File formats that `dataset` writes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneEntry:
    """One drive section: `[[scene]]` of a catalogue."""

    name: str
    """Partition key."""
    root: Path
    """KITTI-360 root that holds `data_3d_raw`, `data_2d_raw`, `data_poses`, `calibration`."""
    sequence: str
    """For example `2013_05_28_drive_0000_sync`."""
    first_frame: int
    """First frame number, inclusive."""
    last_frame: int
    """Last frame number, inclusive."""
    test_frames: tuple[int, ...]
    """Held-out frames: never trained on, never used to choose anything."""
    sweep_period_s: float | None = None
    """Seconds of one LiDAR turn where timestamps are absent; recorded as assumed."""
    cameras: tuple[str, ...] | None = None
    """Cameras to use; None = every camera present and calibrated."""
    recipe: str | None = None
    """Recipe where none is asked for."""
    views: tuple[ViewEntry, ...] = ()
    """The views that apply to this scene."""
