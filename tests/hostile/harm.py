"""What can be done to a file, a table, or a drive."""

import os
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from nvsf_core.drives.kitti360.layout import DriveLayout

Harm = Callable[[Path], None]


def cut(path: Path) -> None:
    """Half of the file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def remove(path: Path) -> None:
    path.unlink()


def flip(path: Path) -> None:
    """One bit in the middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(bytes(content))


def text(new: str) -> Harm:
    """Other text altogether."""
    return lambda path: path.write_text(new) and None


def replaced(pattern: str, by: str) -> Harm:
    """The first match of a pattern, replaced."""

    def harm(path: Path) -> None:
        before = path.read_text()
        after = re.sub(pattern, by, before, count=1, flags=re.MULTILINE)
        assert after != before, f"{path} holds no {pattern}"
        path.write_text(after)

    return harm


def pipe(path: Path) -> None:
    """A FIFO in its place: who opens it waits for ever."""
    path.unlink()
    os.mkfifo(path)


def endless(path: Path) -> None:
    """A link to a device that never ends."""
    path.unlink()
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def sparse(gigabytes: float) -> Harm:
    """A huge file that takes no room."""

    def harm(path: Path) -> None:
        with path.open("r+b") as handle:
            handle.truncate(int(gigabytes * (1 << 30)) // 16 * 16)

    return harm


def no_folder(path: Path) -> None:
    """A pipe in place of a folder."""
    shutil.rmtree(path)
    os.mkfifo(path)


def black(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path))))


def rows(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change one scan's (N, 4) rows."""
    change(np.fromfile(path, "<f4").reshape(-1, 4)).astype("<f4").tofile(path)


def crowded(scan: np.ndarray) -> np.ndarray:
    """Each return three times, turned by less than the encoder can tell."""
    turned = []
    for angle in (0.0, 1e-4, 2e-4):
        x, y = (
            scan[:, 0] * np.cos(angle) - scan[:, 1] * np.sin(angle),
            scan[:, 0] * np.sin(angle) + scan[:, 1] * np.cos(angle),
        )
        turned.append(np.column_stack([x, y, scan[:, 2:]]))
    azimuth = [np.round(np.arctan2(part[:, 1], part[:, 0]), 9) for part in turned]
    laser = np.concatenate([[0], np.cumsum(np.diff(np.mod(azimuth[0], 2 * np.pi)) < -np.pi)])
    every = np.concatenate(turned)
    return every[np.lexsort((np.mod(np.concatenate(azimuth), 2 * np.pi), np.tile(laser, 3)))]


def scans(layout: DriveLayout, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change every scan's (N, 4) rows."""
    for frame in range(4):
        path = layout.scan_path(frame)
        change(np.fromfile(path, "<f4").reshape(-1, 4).copy()).astype("<f4").tofile(path)


def swap(one: Path, other: Path) -> None:
    """Each file under the other's name."""
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


def poses(path: Path, change: Callable[[np.ndarray], None]) -> None:
    """Change the rows of `poses.txt`: frame, then 12 numbers."""
    rows = np.loadtxt(path, ndmin=2)
    change(rows)
    path.write_text("".join(f"{int(row[0])} {' '.join(f'{x:.17g}' for x in row[1:])}\n" for row in rows))


def stamps(step_s: float, pause_s: float = 0.0) -> Harm:
    """Times with another step; `pause_s` before the last frame."""

    def harm(path: Path) -> None:
        start = np.datetime64("2013-05-28T08:00:00", "ns")
        after_s = [step_s * k + (pause_s if k == 3 else 0.0) for k in range(4)]
        times = [start + np.timedelta64(int(1e9 * seconds), "ns") for seconds in after_s]
        path.write_text("".join(f"{str(time).replace('T', ' ')}\n" for time in times))

    return harm


def png(path: Path, *, depth: int = 8, claims: tuple[int, int] | None = None, orientation: int = 0) -> None:
    """Write the image again: in 16 bits a channel, with another size in its header, or turned by EXIF."""
    image = cv2.imread(str(path))
    if depth == 16:
        image = image.astype(np.uint16) * 16  # as a 12-bit camera fills 16 bits
    cv2.imwrite(str(path), image)
    content = path.read_bytes()
    if claims is not None:
        header = struct.pack(">II", *claims) + content[24:29]
        content = content[:8] + _chunk(b"IHDR", header) + content[33:]
    if orientation:
        exif = b"II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHHI", 0x0112, 3, 1, orientation, 0, 0)
        content = content[:33] + _chunk(b"eXIf", exif) + content[33:]
    path.write_bytes(content)


def too_few_pixels(path: Path) -> None:
    """A picture whose compressed rows end half-way, though each chunk's checksum is right."""
    content = path.read_bytes()
    width, height = struct.unpack(">II", content[16:24])
    rows = zlib.compress(b"\0" * (height // 2 * (1 + 3 * width)))
    path.write_bytes(content[:33] + _chunk(b"IDAT", rows) + _chunk(b"IEND", b""))


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
