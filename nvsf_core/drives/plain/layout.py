"""Paths of a plain drive's files (docs/drives.md)."""

from dataclasses import dataclass
from pathlib import Path

from nvsf_core.drives.kitti360.layout import LAST_FRAME

SCAN_KINDS = ("bin", "ply", "pcd")
IMAGE_KINDS = ("png", "jpg", "jpeg")
_MOST_DIGITS = len(str(LAST_FRAME))


@dataclass(frozen=True, slots=True)
class PlainLayout:
    """Paths below a plain drive's folder, whether they exist or not."""

    root: Path

    @property
    def drive_path(self) -> Path:
        """What the LiDAR is and how its files are to be read."""
        return self.root / "drive.json"

    @property
    def poses_path(self) -> Path:
        """Poses, a row each."""
        return self.root / "poses.csv"

    @property
    def frames_path(self) -> Path:
        """Time of each frame, where the poses have no frame numbers."""
        return self.root / "frames.csv"

    @property
    def cameras_path(self) -> Path:
        """Intrinsics, distortion and mounting of each camera."""
        return self.root / "cameras.json"

    @property
    def boxes_path(self) -> Path:
        """Labelled boxes, a row each."""
        return self.root / "boxes.csv"

    @property
    def scans_dir(self) -> Path:
        """A scan a file, named by its frame number."""
        return self.root / "scans"

    def beside_dir(self, column: str) -> Path:
        """`ring` (uint16) or `time` (float32) of the scans' points, a file a scan, named by its number."""
        return self.root / column

    def beside_path(self, column: str, frame: int) -> Path:
        """A file of `beside_dir` as this project writes it."""
        return self.beside_dir(column) / f"{frame:010d}.bin"

    def scan_path(self, frame: int, kind: str = "bin") -> Path:
        """A scan as this project writes it."""
        return self.scans_dir / f"{frame:010d}.{kind}"

    def images_dir(self, camera: str) -> Path:
        """An image a file, named by its frame number."""
        return self.root / "images" / camera

    def image_path(self, camera: str, frame: int) -> Path:
        """An image as this project writes it."""
        return self.images_dir(camera) / f"{frame:010d}.png"

    def image_times_path(self, camera: str) -> Path:
        """Times of a camera's images, where they are not the frames'."""
        return self.images_dir(camera) / "times.csv"


def numbered_files(folder: Path, kinds: tuple[str, ...]) -> dict[int, Path]:
    """Files of a folder by the number that is their name, ascending; other files are not of the format.

    Where two have one number, the first by name is taken.

    Raises:
        OSError: The folder cannot be read.
    """
    return {number: paths[0] for number, paths in files_by_number(folder, kinds).items()}


def files_by_number(folder: Path, kinds: tuple[str, ...]) -> dict[int, list[Path]]:
    """As `numbered_files`, with all files of a number, sorted by name."""
    found: dict[int, list[Path]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        is_number = path.stem.isascii() and path.stem.isdecimal() and len(path.stem) <= _MOST_DIGITS
        if is_number and path.suffix.lower().removeprefix(".") in kinds:
            found.setdefault(int(path.stem), []).append(path)
    return dict(sorted(found.items()))
