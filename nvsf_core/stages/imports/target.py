"""What an imported drive is written into; one class a layout."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import DriveFacts
from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.boxes import Box
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.posed import PosePath


class AbstractTarget(ABC):
    """A drive that is being written, a frame at a time."""

    def __init__(self, folder: Path, scene: SceneEntry, facts: DriveFacts) -> None:
        self.folder = folder
        self.scene = scene
        self.facts = facts
        self.path: PosePath | None = None
        """Poses at a rate of their own, on the clock of the frames' times; None = the frames' alone."""
        self.left_out: list[str] = []
        """What the layout cannot hold, in words; whole after `finish`."""
        self.notes: list[str] = []
        """What the layout holds in another way than the recorded drive; whole after `finish`."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras of the recorded drive that the layout can hold."""
        return tuple(self.facts.calibration.cameras)

    @abstractmethod
    def write_scan(self, frame: int, scan: Scan) -> None:
        """Write a frame's scan."""

    @abstractmethod
    def write_image(self, camera: str, frame: int, rgb: np.ndarray, time_s: float | None) -> None:
        """Write an image (H, W, 3) uint8; `time_s` is its own time after the first frame, if it has one."""

    @abstractmethod
    def finish(self, boxes: Sequence[Box]) -> None:
        """Write calibration, poses, times and boxes."""

    @abstractmethod
    def catalogue_lines(self) -> list[str]:
        """Lines of a `[[scene]]` that say what the layout is."""
