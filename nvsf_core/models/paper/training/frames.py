"""What the paper's training sees: panos and images of the training frames, scaled to the unit cube."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from nvsf_core.errors import DataError
from nvsf_core.geometry.bounds import Bounds
from nvsf_core.recording.images import CameraImages


@dataclass(frozen=True, slots=True, kw_only=True)
class Panos:
    """Range images of k training scans, each seen from its frame's one pose, as the paper does."""

    frame: np.ndarray
    """(k,) float64 frame coordinates: 0 for the scene's first frame, n - 1 for its last."""
    pose: np.ndarray
    """(k, 4, 4) float64 LiDAR to scene-local."""
    range_m: Tensor
    """(k, h, w) float32; 0 where nothing returned."""
    intensity: Tensor
    """(k, h, w) float32; 0 where nothing returned."""
    clouds: tuple[np.ndarray, ...]
    """Scaled points (m, 3) float32 of each scan without ground: what the flow is compared on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Images:
    """The training images of one camera."""

    name: str
    images: CameraImages
    frame: np.ndarray
    """(k,) float64 frame coordinates."""
    range_m: np.ndarray | None = None
    """(k, h, w) float32 ray lengths to the frame's own returns, 0 = none; None where no loss asks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperFrames:
    """All training data of a scene."""

    bounds: Bounds
    count: int
    """n: frames of the scene, held-out ones included; time runs from 0 to n - 1 in frame coordinates."""
    panos: Panos | None
    cameras: tuple[Images, ...]

    def __post_init__(self) -> None:
        """Refuse a scene without anything to learn from."""
        if not len(self.frames):
            raise DataError("expected at least one training scan or image, found none; look at `frames`")

    @property
    def frames(self) -> np.ndarray:
        """Frame coordinates that have a scan or an image, ascending: one is drawn a step."""
        scans = np.zeros(0) if self.panos is None else self.panos.frame
        return np.unique(np.concatenate([scans, *(camera.frame for camera in self.cameras)]))
