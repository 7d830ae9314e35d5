"""The mask of the pixels that light reaches."""

import cv2
import numpy as np

_LIT = 8
"""Grey value that an unlit pixel never reaches."""


def lens_circle(brightest: np.ndarray) -> np.ndarray:
    """The part of a fisheye's image sensor that light through its lens reaches.

    Args:
        brightest: (H, W, 3) uint8, each pixel's largest value over all images of the camera.

    Returns:
        (H, W) bool: false only in dark regions that touch the image's border; a dark object in the
        middle of the image stays valid.
    """
    dark = (brightest.max(axis=2) < _LIT).astype(np.uint8)
    count, labels = cv2.connectedComponents(dark, connectivity=4)
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    outside = np.zeros(count, dtype=bool)
    outside[border] = True
    outside[0] = False  # label 0: not dark
    return np.asarray(~outside[labels])
