"""Validation and decoding of camera images that are PNG or JPEG."""

from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.images import decode_image, decode_pixels, require_picture
from nvsf_core.errors import DataError

_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def decode_picture(path: Path, data: bytes, width: int, height: int) -> np.ndarray:
    """Validate and decode a PNG or JPEG: (height, width, 3) uint8 RGB, in the stored orientation.

    Args:
        path: The file, for messages.
        data: Its bytes.
        width: Expected columns, pixels.
        height: Expected rows, pixels.

    Raises:
        DataError: It is damaged, or of another size or depth.
    """
    if not data.startswith(_JPEG_BEGIN):
        return decode_image(path, data, width, height)
    # The decoder fills a truncated image with grey, silently.
    if _JPEG_END not in data[-64:]:
        raise DataError(f"{path}: unreadable image, truncated; copy it again")
    rgb = decode_pixels(path, data)
    if rgb.shape != (height, width, 3):
        raise DataError(
            f"{path}: wrong size, expected {width} x {height} as the calibration says, found "
            f"{rgb.shape[1]} x {rgb.shape[0]}; use the calibration of this drive"
        )
    require_picture(path, rgb)
    return rgb
