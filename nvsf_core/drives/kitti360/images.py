"""Reading and validation of camera images: PNG files, and JPEGs of other drives, as RGB."""

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from nvsf_core.drives.kitti360.text import read_bytes
from nvsf_core.errors import DataError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MOST_PIXEL_BYTES = 4
"""Most bytes of a pixel in a PNG: noise in four channels of 8 bits cannot be compressed."""
_HEADROOM_BYTES = 1 << 20
"""For headers and other data in the file."""
_ORIENTATION_TAG = 0x0112
_UPRIGHT = 1
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Values a pixel by a PNG's colour type: grey, colour, palette, grey and opacity, colour and opacity."""


def read_image(path: Path, width: int, height: int) -> np.ndarray:
    """Read a PNG file with 8 bits a channel, or a JPEG, as (height, width, 3) uint8 RGB.

    Raises:
        DataError: See `decode_picture`; or the file is absent or too large.
    """
    return decode_picture(path, read_image_bytes(path, width, height), width, height)


def read_image_bytes(path: Path, width: int, height: int) -> bytes:
    """The bytes of an image's file, not validated.

    Raises:
        DataError: It is absent, not a regular file, or too large for an image of that size.
    """
    return read_bytes(path, _HEADROOM_BYTES + _MOST_PIXEL_BYTES * width * height, "image")


def decode_image(path: Path, data: bytes, width: int, height: int) -> np.ndarray:
    """Validate and decode an image's bytes: (height, width, 3) uint8 RGB.

    Raises:
        DataError: It is damaged, or of another size, depth or orientation.
    """
    # The header is checked before the decoder allocates memory for it.
    fault = _png_fault(data) or _header_fault(data, width, height)
    if fault:
        raise DataError(f"{path}: {fault}")
    rgb = decode_pixels(path, data)
    require_picture(path, rgb)
    if rgb.shape != (height, width, 3):
        raise DataError(f"{path}: unreadable image, no decoder accepts it; copy it again")
    return rgb


def decode_pixels(path: Path, data: bytes) -> np.ndarray:
    """Decode an image of any format and size that the decoder knows: (H, W, 3) uint8 RGB.

    Raises:
        DataError: The decoder does not accept it.
    """
    try:
        # Pixels in the stored orientation, which is the calibrated camera's.
        decoded = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error as error:
        raise DataError(f"{path}: unreadable image, its decoder says {error}; copy it again") from error
    if decoded is None:
        raise DataError(f"{path}: unreadable image, no decoder accepts it; copy it again")
    return np.ascontiguousarray(decoded[:, :, ::-1])


def require_picture(path: Path, rgb: np.ndarray) -> None:
    """Check that the pixels of an image are not all alike.

    Raises:
        DataError: They are.
    """
    if rgb.min() == rgb.max():
        raise DataError(f"{path}: expected a picture, found one value in all pixels; the camera sent nothing")


def _png_fault(data: bytes) -> str | None:
    """What is wrong with a PNG's chunks, or None. The decoder fills a truncated image with grey, silently."""
    if not data.startswith(_PNG_SIGNATURE):
        return f"unreadable image, {'no PNG signature' if data else 'empty file'}; copy it again"
    for name, body, checksum in _chunks(data):
        if len(checksum) < 4:
            break
        if zlib.crc32(name + body) != int.from_bytes(checksum, "big"):
            return f"unreadable image, checksum of chunk {name.decode('latin-1')!r} is wrong; copy it again"
        if name == b"IEND":
            return None
    return "unreadable image, truncated; copy it again"


def _header_fault(data: bytes, width: int, height: int) -> str | None:
    """What is wrong with an image's size, depth, pixels or orientation, or None."""
    name, header, _ = next(_chunks(data))
    if name != b"IHDR" or len(header) != 13:
        return "unreadable image, its first chunk is no header; copy it again"
    found = (int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big"))
    if found != (width, height):
        return (
            f"wrong size, expected {width} x {height} as the calibration says, "
            f"found {found[0]} x {found[1]}; use the calibration of this drive"
        )
    if header[8] > 8:
        return (
            f"expected 8 bits a channel, found {header[8]}: whether it uses all of them cannot be known; "
            "convert the drive's images to 8 bits"
        )
    if not _is_whole(data, header):
        return "unreadable image, its pixels are damaged or too few; copy it again"
    turned = [body for name, body, _ in _chunks(data) if name == b"eXIf" and _orientation(body) != _UPRIGHT]
    if turned:
        return (
            f"expected pixels as the camera recorded them, found EXIF orientation {_orientation(turned[0])}: "
            "the calibration speaks of stored pixels; turn the image for good or remove the tag"
        )
    return None


def _is_whole(data: bytes, header: bytes) -> bool:
    """Whether there are as many pixels as the header says; the decoder would fill missing ones with grey."""
    width, height = int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big")
    if header[12]:  # interlaced: seven small images with rows of other lengths, not checked
        return True
    row_bits = width * header[8] * _CHANNELS.get(header[9], 0)
    expected = height * (1 + (row_bits + 7) // 8)
    packed = b"".join(body for name, body, _ in _chunks(data) if name == b"IDAT")
    try:
        return len(zlib.decompressobj().decompress(packed, expected + 1)) == expected
    except zlib.error:
        return False


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """Name, content and checksum of each chunk; the last may be incomplete."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        body = data[position + 8 : position + 8 + length]
        yield data[position + 4 : position + 8], body, data[position + 8 + length : position + 12 + length]
        position += 12 + length


def _orientation(exif: bytes) -> int:
    """Orientation tag of EXIF data, 1 to 8 (EXIF 2.32); upright if there is none."""
    order: Literal["little", "big"] = "little" if exif[:2] == b"II" else "big"
    start = int.from_bytes(exif[4:8], order)
    for entry in range(int.from_bytes(exif[start : start + 2], order)):
        field = exif[start + 2 + 12 * entry : start + 14 + 12 * entry]
        if len(field) < 12:
            break
        if int.from_bytes(field[:2], order) == _ORIENTATION_TAG:
            return int.from_bytes(field[8:10], order)
    return _UPRIGHT


_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a frame's header; the three others are of tables."""


def decode_picture(path: Path, data: bytes, width: int, height: int) -> np.ndarray:
    """Validate and decode bytes of a PNG or JPEG: (height, width, 3) uint8 RGB, in the stored orientation.

    Raises:
        DataError: It is damaged, or of another size or depth.
    """
    if not data.startswith(_JPEG_BEGIN):
        return decode_image(path, data, width, height)
    # The decoder fills a truncated image with grey, silently.
    if _JPEG_END not in data[-64:]:
        raise DataError(f"{path}: unreadable image, truncated; copy it again")
    # As of a PNG, before the decoder allocates memory for it.
    size = jpeg_size(data)
    if size != (width, height):
        raise DataError(
            f"{path}: wrong size, expected {width} x {height} as the calibration says, found "
            f"{'none' if size is None else f'{size[0]} x {size[1]}'}; use the calibration of this drive"
        )
    rgb = decode_pixels(path, data)
    require_picture(path, rgb)
    return rgb


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Columns and rows of the frame header of a JPEG (ITU-T T.81, B.2.2); None without one."""
    position = len(_JPEG_BEGIN)
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
        elif marker in _JPEG_FRAMES:
            rows, columns = (int.from_bytes(data[position + k : position + k + 2], "big") for k in (5, 7))
            return columns, rows
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return None
