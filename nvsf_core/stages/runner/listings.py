"""Digests of recorded files by names, sizes and change times: whether what a stage reads has changed."""

import hashlib
import os
from pathlib import Path

from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.drives.view_truth import truth_files
from nvsf_core.errors import DataError

_MOST_FILES = 500_000
"""Most files of one sequence: KITTI-360's longest has 15,000 frames of five sensors."""


def drive_listing(scene: SceneEntry) -> str:
    """Digest of names, sizes and change times of the drive's files; no file is read.

    Raises:
        DataError: There are too many files: a link leads to another place.
    """
    digest = hashlib.sha256()
    folders = [scene.root / "calibration"] + [
        scene.root / kind / scene.sequence for kind in ("data_3d_raw", "data_2d_raw", "data_poses")
    ]
    files = [path for folder in folders for path in _files_below(folder)]
    files += sorted((scene.root / "data_3d_bboxes").glob(f"*/{scene.sequence}.xml"))
    for path in files:
        if path.is_file():
            digest.update(_line(path, path.relative_to(scene.root).as_posix()))
    return digest.hexdigest()


def truth_listing(scene: SceneEntry) -> str:
    """Digest of names, sizes and change times of the views' true images; no file is read.

    Raises:
        DataError: A view names images that are not there.
    """
    digest = hashlib.sha256()
    for view in scene.views:
        for camera, files in truth_files(scene, view).items():
            for path in files.values():
                digest.update(_line(path, f"{view.name} {camera} {path.name}"))
    return digest.hexdigest()


def _line(path: Path, name: str) -> bytes:
    stat = path.stat()
    return os.fsencode(f"{name} {stat.st_size} {stat.st_mtime_ns}\n")


def _files_below(folder: Path) -> list[Path]:
    """All files below a folder, in the order of their paths."""
    found: list[Path] = []
    for place, _, names in os.walk(folder):
        found += [Path(place) / name for name in names]
        if len(found) > _MOST_FILES:
            raise DataError(
                f"{folder}: expected the files of one drive, found more than {_MOST_FILES:,}; is it a link "
                "to another place?"
            )
    return sorted(found)
