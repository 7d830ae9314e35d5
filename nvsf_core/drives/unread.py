"""What lies in a drive's folders and would be passed over: files and folders of other names, two of a frame.

A sensor whose files all have other names would disappear without a word: that is refused. What lies beside
files that are read is named.
"""

import os
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from pathlib import Path

from nvsf_core.drives.plain.layout import (
    IMAGE_KINDS,
    SCAN_KINDS,
    PlainLayout,
    files_by_number,
    numbered_files,
)
from nvsf_core.errors import DataError

_TABLES = ("drive.json", "poses.csv", "frames.csv", "cameras.json", "boxes.csv")
_FOLDERS = ("scans", "images", "ring", "time")
_TIMES = "times.csv"
"""Beside a camera's images."""
_LEAST_LIKENESS = 0.8
"""Of a misspelt name to the right one, by `difflib`: `scan`, `rings` and `pose.csv` have 0.89 and more."""


def unnamed_files(folder: Path, kinds: tuple[str, ...]) -> list[str]:
    """Words on files of these kinds that no frame's number names, beside others that are.

    Raises:
        DataError: There are files or folders, and none is a frame's.
        OSError: The folder cannot be read.
    """
    if not folder.is_dir():
        return []
    named = {path for paths in files_by_number(folder, kinds).values() for path in paths}
    there = {path for path in folder.iterdir() if not path.name.startswith(".") and path.name != _TIMES}
    others = sorted(there - named)
    if named:
        others = [path for path in others if _is_of(path, kinds)]
    if not others:
        return []
    words = (
        f"{folder}: expected files named by their frame, as 0000000123.{kinds[0]}, found {len(others)} of "
        f"other names, as {others[0].name!r:.60}; rename them"
    )
    if not named:
        raise DataError(f"{words}, or remove the folder")
    return [words]


def require_one_of_each(folder: Path, kinds: tuple[str, ...], frames: Collection[int]) -> None:
    """Refuse a folder with two files of a frame.

    Raises:
        DataError: There are two; the message names both.
        OSError: The folder cannot be read.
    """
    for frame, paths in files_by_number(folder, kinds).items():
        if len(paths) > 1 and frame in frames:
            raise DataError(
                f"{folder}: expected one file of frame {frame}, found {paths[0].name} and {paths[1].name}; "
                "remove one"
            )


def unknown_names(layout: PlainLayout, *, has_scans: bool, lacks_images: bool) -> list[str]:
    """Words on files and folders of a plain drive whose names are nearly those that are read.

    Args:
        layout: The drive.
        has_scans: Whether scans were found where they are expected.
        lacks_images: Whether cameras are described, and no images were found where they are expected.

    Raises:
        DataError: Scans, or images of described cameras, lie in another folder alone.
        OSError: A folder cannot be read.
    """
    if not layout.root.is_dir():
        return []
    there = sorted(path for path in layout.root.iterdir() if not path.name.startswith("."))
    strange = [path for path in there if path.name not in (*_TABLES, *_FOLDERS)]
    folders = [layout.root, *with_folders_below(strange)]
    if not has_scans:
        require_none_in(folders, layout.scans_dir, SCAN_KINDS)
    if lacks_images:
        images = layout.root / "images"
        require_none_in([images, *folders], images / "CAMERA", IMAGE_KINDS)
    absent = [name for name in (*_TABLES, *_FOLDERS) if not (layout.root / name).exists()]
    words = []
    for path in strange:
        meant = get_close_matches(path.name.lower(), absent, 1, _LEAST_LIKENESS)
        words += [f"{path} is not read: expected the name {one}; rename it, or move it away" for one in meant]
    return words


def require_none_in(folders: Iterable[Path], expected: Path, kinds: tuple[str, ...]) -> None:
    """Refuse folders with files of frames, where there are none in the expected one.

    Raises:
        DataError: There are some; the message says where.
    """
    for folder in folders:
        found = files_by_number(folder, kinds)
        if found:
            raise DataError(
                f"{folder}: found {len(found)} files as {next(iter(found.values()))[0].name}, and none in "
                f"{expected}, where they are expected; move them there, or away from the drive"
            )


def with_folders_below(places: Iterable[Path]) -> list[Path]:
    """The folders among some paths, and those in them; without those that may not be read."""
    folders = [path for path in places if _is_readable(path)]
    return folders + [path for one in folders for path in sorted(one.iterdir()) if _is_readable(path)]


def require_files_of_scans(folder: Path, scans: Collection[int]) -> None:
    """Refuse a folder of values of scans' points none of whose files has the number of one of these scans.

    Raises:
        DataError: There are files, and none has.
        OSError: The folder cannot be read.
    """
    there = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    if there and not numbered_files(folder, ("bin",)).keys() & set(scans):
        raise DataError(
            f"{folder}: expected files named by the numbers of scans, as 0000000000.bin, found "
            f"{min(there)!r:.60}; rename them, or remove the folder"
        )


def _is_readable(path: Path) -> bool:
    return path.is_dir() and os.access(path, os.R_OK | os.X_OK)


def _is_of(path: Path, kinds: tuple[str, ...]) -> bool:
    return path.suffix.lower().removeprefix(".") in kinds
