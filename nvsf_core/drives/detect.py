"""Which format a recording on disk is of, and which frames it has."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from nvsf_core.drives.drive import drive_of
from nvsf_core.drives.entries import KITTI_ODOMETRY, SceneEntry
from nvsf_core.drives.kitti360.frames import MOST_TIMESTAMP_BYTES
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.scans import MOST_RETURNS
from nvsf_core.drives.kitti360.text import read_bytes
from nvsf_core.errors import DataError
from nvsf_core.names import RESERVED_SCENES

_WHOLE = (0, 1)
"""Frames of the entry by which a drive is asked for all that it has."""
_TIMES_OF_POINTS = "velodyne_time"
"""Folder beside the scans of a KITTI odometry's sequence that this project wrote."""
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_-]+")


def kind_of(source: Path) -> str:
    """The format of a recording: `kind` of a catalogue's scene.

    Raises:
        DataError: It is none that is known; the message says what each looks like.
    """
    if source.is_file() and source.suffix.lower() in (".bag", ".mcap"):
        return "bag"
    if source.is_dir():
        if (source / "metadata.yaml").is_file() or any(source.glob("*.mcap")):
            return "bag"
        if (source / "data_3d_raw").is_dir() or (source / "data_2d_raw").is_dir():
            return "kitti360"
        if (source / "sequences").is_dir():
            return "kitti_odometry"
        if any(source.glob("*_drive_*_*/velodyne_points")) or any(source.glob("*_drive_*_*/image_0[0-3]")):
            return "kitti_raw"
        if any((source / name).exists() for name in ("scans", "images", "poses.csv")):
            return "plain"
    raise DataError(
        f"{source}: expected a recording, found {'another folder or file' if source.exists() else 'nothing'}"
        ": a bag (.bag, .mcap, or a folder with metadata.yaml), KITTI-360's root (data_3d_raw), KITTI "
        "odometry's (sequences), a date of KITTI raw (*_drive_*_sync), or plain files (scans, poses.csv: "
        "docs/drives.md); name another place"
    )


def whole_drive(
    source: Path, kind: str, sequence: str = "", lidar: str | None = None,
    first: int | None = None, last: int | None = None, lidar_topic: str | None = None,
) -> SceneEntry:  # fmt: skip
    """An entry of all frames that a recording has, or of some.

    What this project wrote says by its times whether its scans are to be compensated; see `_compensate`.

    Args:
        source: Its root, as in a catalogue.
        kind: Its format.
        sequence: Its name there; empty = the only one.
        lidar: The sensor's name, or `found`; None = as the recording says.
        first: First frame; None = the first there is.
        last: Last frame; None = the last there is.
        lidar_topic: Of a bag, the topic of point clouds to read; None = see `SceneEntry`.

    Raises:
        DataError: There is no such sequence, several and none is named, no frame, or not those asked for.
    """
    name = _NOT_IN_NAMES.sub("_", sequence or source.stem).strip("_-") or "drive"
    # A recording may well lie in a folder `drives`.
    name = f"{name}_drive" if name in RESERVED_SCENES else name
    chosen = sequence or _only_sequence(source, kind) or name
    entry = SceneEntry(
        name=name[:60], root=source.absolute(), sequence=chosen, first_frame=_WHOLE[0], last_frame=_WHOLE[1],
        test_frames=(), kind=kind, lidar=lidar, lidar_topic=lidar_topic,
        compensate=_compensate(source, kind, chosen),
    )  # fmt: skip
    try:
        source_drive = drive_of(entry)
        recorded = source_drive.section().recorded
        if recorded is None:
            source_drive.unread()
    except OSError as error:
        raise DataError(f"{source}: cannot be read ({error.strerror}); check its permissions") from error
    if recorded is None:
        raise DataError(f"{source}, sequence {chosen}: expected scans or images, found none")
    begin, end = recorded[0] if first is None else first, recorded[1] if last is None else last
    if not recorded[0] <= begin <= end <= recorded[1]:
        given = [f"{word} {one}" for word, one in (("first", first), ("last", last)) if one is not None]
        raise DataError(
            f"expected frames within {recorded[0]} to {recorded[1]}, the first before the last, found "
            f"{' and '.join(given)}; correct --first or --last"
        )
    return replace(entry, first_frame=begin, last_frame=end)


def _compensate(source: Path, kind: str, sequence: str) -> bool | None:
    """Whether scans are to be compensated, where a tree says other than its kind; None = it does not.

    The times of points beside our scans of `kitti` say that a moving sensor recorded them, unless all are 0.
    Scans of `kitti360` that end when they begin are of one instant.
    """
    if kind == KITTI_ODOMETRY:
        scans = sorted((source / "sequences" / sequence / _TIMES_OF_POINTS).glob("*.bin"))
        times = (read_bytes(path, 4 * MOST_RETURNS, "times of points") for path in scans)
        return True if any(_is_any_set(one) for one in times) else None
    if kind == "kitti360":
        layout = DriveLayout(source, sequence)
        paths = [layout.timestamps_path(which) for which in ("start", "end")]
        if not all(path.is_file() for path in paths):
            return None
        begin, end = (read_bytes(path, MOST_TIMESTAMP_BYTES, "timestamps") for path in paths)
        return False if begin == end else None
    return None


def _is_any_set(times: bytes) -> bool:
    """Whether a time (float32) is not 0; a rest of bytes is refused where the scan is read."""
    # Not by bytes: times of a scan of one instant may be -0.
    return bool(np.frombuffer(times, "<f4", len(times) // 4).any())


def _only_sequence(source: Path, kind: str) -> str:
    """The one sequence below a root; empty for formats that have no sequences."""
    folders = {
        "kitti360": [source / "data_3d_raw", source / "data_2d_raw"],
        "kitti_odometry": [source / "sequences"],
        "kitti_raw": [source],
    }.get(kind, [])
    found = {
        path.name for folder in folders if folder.is_dir() for path in folder.iterdir()
        if path.is_dir() and (kind != "kitti_raw" or "_drive_" in path.name)
    }  # fmt: skip
    if len(found) > 1:
        raise DataError(
            f"{source}: expected one sequence, found {', '.join(sorted(found))!s:.300}; name it (--sequence)"
        )
    return found.pop() if found else ""
