"""Writing pictures."""

from pathlib import Path

import cv2
import numpy as np

from nvsf_core.errors import ShapeError, StoreError


def write_image(path: Path, rgb: np.ndarray) -> None:
    """Write an (H, W, 3) uint8 picture, red first, as the format that the file name's ending says.

    Raises:
        ShapeError: The array is no picture of bytes.
        StoreError: The file could not be written.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ShapeError(f"{path}: expected a picture (H, W, 3) uint8, found {rgb.shape} {rgb.dtype}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(rgb[:, :, ::-1])):
        raise StoreError(f"{path}: the picture could not be written; is the disk full or the ending unknown?")
