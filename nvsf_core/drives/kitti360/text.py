"""Reading of a drive's files up to a size limit, and parsing of numbers, rigid transforms and keyed lines."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from os.path import lexists
from pathlib import Path
from typing import Self

import numpy as np

from nvsf_core.errors import CalibrationError, DataError

MIB = 1 << 20
FARTHEST_M = 3e7
"""Largest coordinate of a place on Earth in any map; Mercator's end at 2e7."""
_LONGEST_ARM_M = 100.0
"""Largest distance of a sensor from the pose frame's origin."""
_MOST_CALIBRATION_BYTES = MIB
"""Largest calibration file; KITTI-360's have up to 3 kB."""
_ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of `R R^T - 1` of a rotation that was printed with few digits."""
_PRINTED_TOLERANCE = 1e-6
"""Up to this entry of `R R^T - 1` the printed rotation is used, beyond it the nearest true rotation."""


def read_text(path: Path, most_bytes: int) -> str:
    """The text of a regular file of at most `most_bytes`.

    Raises:
        OSError: It is absent or cannot be read.
        ValueError: It is a folder, a pipe or a device, too large, or not UTF-8; the message says which.
    """
    require_regular(path, most_bytes)
    # With or without a byte order mark.
    return path.read_text(encoding="utf-8-sig")


def require_regular(path: Path, most_bytes: int) -> None:
    """Refuse what is not a regular file of at most `most_bytes`.

    Raises:
        OSError: It is absent.
        ValueError: It is a folder, a pipe or a device, or too large; the message says which.
    """
    if lexists(path) and not path.is_file():
        raise ValueError("expected a regular file, found a folder, a pipe or a device, or a link to nowhere")
    size = path.stat().st_size
    if size > most_bytes:
        raise ValueError(f"expected at most {most_bytes:,} bytes, found {size:,}")


def require_folder(path: Path) -> bool:
    """Whether there is a folder of that name.

    Raises:
        DataError: There is something else of that name.
    """
    if lexists(path) and not path.is_dir():
        raise DataError(
            f"{path}: expected a folder, found a file, a pipe or a broken link; unpack the drive again"
        )
    return path.is_dir()


def parse_numbers(text: str, count: int) -> np.ndarray:
    """Exactly `count` finite numbers separated by blanks, (count,) float64.

    Raises:
        ValueError: There are more or fewer, or one is not a finite number; the message says which.
    """
    words = text.split(maxsplit=count)
    if len(words) != count:
        raise ValueError(f"expected {count} numbers, found {len(words) if len(words) < count else 'more'}")
    # Python also reads `1_000` and digits of other scripts; no drive has them.
    if "_" in text or not text.isascii():
        raise ValueError("expected numbers in plain digits")
    values = np.array([float(word) for word in words])
    if not np.isfinite(values).all():
        raise ValueError("expected finite numbers, found NaN or infinity")
    return values


def rigid(values: np.ndarray, farthest_m: float) -> np.ndarray:
    """A rigid transform (4, 4) from its upper three rows; its 3x3 part is a rotation to 1e-6.

    Args:
        values: (12,) numbers, row by row.
        farthest_m: Largest allowed coordinate of the translation.

    Raises:
        ValueError: The 3x3 part is not a rotation, or the translation is too far.
    """
    matrix = np.eye(4)
    matrix[:3] = values.reshape(3, 4)
    matrix[:3, :3] = rotation(matrix[:3, :3])
    if np.abs(matrix[:3, 3]).max() > farthest_m:
        raise ValueError(
            f"expected a translation within {farthest_m:g} m, found {np.array2string(matrix[:3, 3])}"
        )
    return matrix


def rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to a printed `matrix` (3, 3), or the matrix itself if it is exact enough.

    Raises:
        ValueError: `matrix` is not a rotation.
    """
    deviation = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    # The deviation is not finite if entries of 1e200 overflow.
    if deviation <= _ORTHONORMAL_TOLERANCE and np.linalg.det(matrix) < 0:
        raise ValueError("expected a rotation, found one with a mirror in it (determinant -1)")
    if not deviation <= _ORTHONORMAL_TOLERANCE:
        raise ValueError(f"expected a rotation, found a matrix with |R R^T - 1| up to {deviation:.3g}")
    if deviation <= _PRINTED_TOLERANCE:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


@dataclass(frozen=True, slots=True)
class KeyedText:
    """The lines `key: value` of a calibration file."""

    path: Path
    lines: dict[str, tuple[int, str]]
    """Key to line number and value."""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file; nesting and a leading % directive are ignored.

        Raises:
            CalibrationError: The file is absent, not a regular file, too large, or has a key twice.
        """
        lines: dict[str, tuple[int, str]] = {}
        for number, line in enumerate(read_calibration_text(path).splitlines(), start=1):
            key, colon, value = line.strip().partition(":")
            if not colon or key.startswith("%"):
                continue
            if key.strip() in lines:
                first = lines[key.strip()][0]
                raise CalibrationError(
                    f"{path}, line {number}: key {key.strip()!r} stands in line {first} already; "
                    "restore the file of the drive: which of the two is true cannot be known"
                )
            lines[key.strip()] = (number, value.strip())
        return cls(path, lines)

    def word(self, key: str) -> str:
        """The value of a key, as text.

        Raises:
            CalibrationError: There is no such key.
        """
        if key not in self.lines:
            found = ", ".join(sorted(self.lines)[:40]) or "no keys"
            raise CalibrationError(
                f"{self.path}: key {key!r} is missing (found {found}); "
                "restore the file of the drive, or name the cameras to use in the catalogue"
            )
        return self.lines[key][1]

    def matrix(
        self, key: str, shape: tuple[int, ...], read: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> np.ndarray:
        """The numbers of a key, float64 of that shape, or what `read` makes of them.

        Raises:
            CalibrationError: There is no such key, or another number of finite numbers, or `read` raised a
                ValueError.
        """
        text = self.word(key)
        try:
            return read(parse_numbers(text, int(np.prod(shape))).reshape(shape))
        except ValueError as error:
            raise self.fault(key, str(error)) from error

    def value(self, key: str) -> float:
        """The number of a key.

        Raises:
            CalibrationError: There is no such key, or its value is not a finite number.
        """
        return float(self.matrix(key, (1,))[0])

    def fault(self, key: str, found: str) -> CalibrationError:
        """An error that names file, line and key."""
        return CalibrationError(
            f"{self.path}, line {self.lines[key][0]}, {key}: {found}; restore the file of the drive"
        )

    def mounting(self, key: str) -> np.ndarray:
        """A key's twelve numbers as a rigid transform (4, 4) between two sensors' frames.

        Raises:
            CalibrationError: There is no such key, or its value is not a rigid transform.
        """
        return self.matrix(key, (3, 4), lambda values: rigid(values, _LONGEST_ARM_M))


def read_mounting(path: Path) -> np.ndarray:
    """A file's twelve numbers as a rigid transform (4, 4) between two sensors' frames.

    Raises:
        CalibrationError: The file is absent or does not hold a rigid transform.
    """
    try:
        return rigid(parse_numbers(read_calibration_text(path), 12), _LONGEST_ARM_M)
    except ValueError as error:
        raise CalibrationError(f"{path}, line 1: {error}; restore the file of the drive") from error


def read_calibration_text(path: Path) -> str:
    """The text of a calibration file.

    Raises:
        CalibrationError: It is absent, not a regular file, too large, or not text.
    """
    try:
        return read_text(path, _MOST_CALIBRATION_BYTES)
    except (OSError, ValueError) as error:
        raise CalibrationError(
            f"cannot read calibration file {path} ({error}); unpack the drive's `calibration` folder there"
        ) from error


def read_bytes(path: Path, most_bytes: int, what: str) -> bytes:
    """The bytes of a regular file; its size is checked before it is read.

    Raises:
        DataError: It is absent, a folder, a pipe or a device, or too large.
    """
    try:
        require_regular(path, most_bytes)
        return path.read_bytes()
    except ValueError as error:
        raise DataError(f"{path}: no {what}, {error}; copy it again") from error
    except OSError as error:
        raise DataError(f"no {what} file {path} ({error.strerror}); unpack the drive's {what}s") from error


def checksum_of(data: bytes) -> str:
    """First 16 hex digits of the SHA-256 of a file's bytes."""
    return hashlib.sha256(data).hexdigest()[:16]
