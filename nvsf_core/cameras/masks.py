"""Which pixels of a view show something of the recorded image."""

import cv2
import numpy as np


def inside_source(map_u: np.ndarray, map_v: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where a resampling map reads wholly inside its source image.

    Args:
        map_u: (H, W) column that each pixel reads, pixels; NaN = nothing.
        map_v: (H, W) row that each pixel reads.
        width: Columns of the source.
        height: Rows of the source.

    Returns:
        (H, W) bool: all four pixels that bilinear sampling mixes exist.
    """
    return np.asarray((map_u >= 0.0) & (map_u <= width - 1.0) & (map_v >= 0.0) & (map_v <= height - 1.0))


def lens_circle(brightest: np.ndarray, threshold: int = 8) -> np.ndarray:
    """The part of a fisheye's sensor that its lens ever lights.

    Args:
        brightest: (H, W, 3) uint8, each pixel's largest value over all images of the camera.
        threshold: Grey value that an unlit pixel never reaches.

    Returns:
        (H, W) bool: false only in dark regions that touch the image's border; a dark object in the
        middle of the image stays valid.
    """
    dark = (brightest.max(axis=2) < threshold).astype(np.uint8)
    count, labels = cv2.connectedComponents(dark, connectivity=4)
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    outside = np.zeros(count, dtype=bool)
    outside[border] = True
    outside[0] = False  # label 0 is what is not dark
    return np.asarray(~outside[labels])
