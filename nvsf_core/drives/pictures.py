"""Reading and validation of camera images that are PNG or JPEG."""

from pathlib import Path

import cv2
import numpy as np

from nvsf_core.drives.kitti360.images import decode_image, read_image_bytes
from nvsf_core.errors import DataError

_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def read_picture_bytes(path: Path, width: int, height: int) -> bytes:
    """The bytes of an image's file, not validated.

    Raises:
        DataError: It is absent, not a regular file, or too large for an image of that size.
    """
    return read_image_bytes(path, width, height)


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
    try:
        decoded = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error as error:
        raise DataError(f"{path}: unreadable image, its decoder says {error}; copy it again") from error
    if decoded is None:
        raise DataError(f"{path}: unreadable image, no decoder accepts it; copy it again")
    if decoded.shape != (height, width, 3):
        raise DataError(
            f"{path}: wrong size, expected {width} x {height} as the calibration says, found "
            f"{decoded.shape[1]} x {decoded.shape[0]}; use the calibration of this drive"
        )
    if decoded.min() == decoded.max():
        raise DataError(f"{path}: expected a picture, found one value in all pixels; the camera sent nothing")
    return np.ascontiguousarray(decoded[:, :, ::-1])
