"""Camera images: PNG files, read as RGB."""

import zlib
from pathlib import Path

import cv2
import numpy as np

from nvsf_core.errors import DataError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_image(path: Path, width: int, height: int) -> np.ndarray:
    """Read an image as (height, width, 3) uint8 RGB.

    Raises:
        DataError: The file is absent, damaged, or of another size.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"no image file {path} ({error.strerror}); unpack the drive's images") from error
    fault = _png_fault(data)
    if fault:
        raise DataError(f"{path}: unreadable image, {fault}; copy it again")
    decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        raise DataError(f"{path}: unreadable image, no decoder accepts it; copy it again")
    if decoded.shape[:2] != (height, width):
        raise DataError(
            f"{path}: wrong size, expected {width} x {height} as the calibration says, "
            f"found {decoded.shape[1]} x {decoded.shape[0]}; use the calibration of this drive"
        )
    return np.ascontiguousarray(decoded[:, :, ::-1])


def _png_fault(data: bytes) -> str | None:
    """What is wrong with a PNG's chunks: the decoder fills a truncated picture with grey and says nothing."""
    if not data.startswith(_PNG_SIGNATURE):
        return "no PNG signature" if data else "empty file"
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        body = data[position + 4 : position + 8 + length]
        checksum = data[position + 8 + length : position + 12 + length]
        if len(checksum) < 4:
            return "truncated"
        if zlib.crc32(body) != int.from_bytes(checksum, "big"):
            return f"checksum of chunk {body[:4].decode('latin-1')!r} is wrong"
        if body[:4] == b"IEND":
            return None
        position += 12 + length
    return "truncated"
