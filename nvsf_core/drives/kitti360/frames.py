"""Frames of a drive in KITTI-360's layout: their times, recorded or nominal, and the car's poses."""

import re
from dataclasses import dataclass, replace
from os.path import lexists
from pathlib import Path

import numpy as np

from nvsf_core.drives.kitti360.layout import CAMERAS, LAST_FRAME, DriveLayout
from nvsf_core.drives.kitti360.text import FARTHEST_M, MIB, parse_numbers, read_text, rigid
from nvsf_core.errors import DataError

NOMINAL_PERIOD_S = 0.1
"""Time from frame to frame if neither the drive nor the catalogue gives it: a rotating LiDAR at 10 Hz."""
SHORTEST_STEP_S, LONGEST_STEP_S = 0.01, 2.0
"""Limits of the median step from frame to frame: LiDARs rotate at 5 to 20 Hz, cameras have 1 to 100 Hz."""
LEAST_OF_MEDIAN = 0.05
"""Smallest step in median steps; smaller ones are errors of the file."""
UNLIKE = 0.1
"""Least difference of a sweep's duration from the frames' step, in steps, for it to be another: a LiDAR that
records all sweeps has the step's, which is measured over the whole section."""
LONGEST_PAUSE_S = 10.0
"""Longest step within a section; after a longer one it is another recording, or the unit is wrong."""
FIRST_DATE_S = 946_684_800.0
"""Seconds from 1970-01-01 to 2000-01-01; what is earlier is no date of a recording."""
MOST_TIMESTAMP_BYTES = 64 * MIB
_MOST_LINES, _MOST_POSE_BYTES = 100_000, 32 * MIB
"""The longest drive of KITTI-360 has 15,000 frames, in 4 MB."""
_LONGEST_SHOWN = 60
_WITHOUT = "its times are then assumed"
# datetime64[ns] overflows silently outside of 1678 to 2262.
_TIME = re.compile(r"(?:1[7-9]|2[01])\d\d-\d\d-\d\d[ T]\d\d:\d\d:\d\d(?:\.\d{1,9})?", re.ASCII)


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """Times of a section's frames."""

    time_s: np.ndarray
    """(n,) float64, seconds since the first frame, for each frame number of the section."""
    sweep_period_s: float
    """Duration of a sweep."""
    is_assumed: bool
    """True if times and period are nominal, not recorded."""
    source: str
    """The file, or why none was used."""
    is_refused: bool = False
    """True if there are recorded times that cannot be used."""
    origin_s: float | None = None
    """Seconds from 1970-01-01 to the first frame, on the recording's own clock; None = not known."""


def frame_times(
    layout: DriveLayout, first_frame: int, last_frame: int, given_period_s: float | None
) -> FrameTimes:
    """Times of the frames `first_frame..last_frame`, inclusive, and the duration of a sweep.

    A drive's timestamp file has one line a frame, from frame 0; if the drive was cut out of a longer one, it
    may have lines for its own frames only. The numbers of lines and of scans decide which. If neither fits,
    the nominal period is used, and `source` gives the reason.

    A sweep lasts as given, else as the scans' files of begins and ends say; see `sweep_of`.

    Args:
        layout: The drive's paths.
        first_frame: First frame number.
        last_frame: Last frame number.
        given_period_s: Duration of a sweep, and time from frame to frame if there are no usable times; None =
            as recorded, and `NOMINAL_PERIOD_S`.

    Raises:
        DataError: A line is not a time.
    """
    path = _timestamp_file(layout)
    count = last_frame - first_frame + 1
    period_s = NOMINAL_PERIOD_S if given_period_s is None else given_period_s
    if path is None:
        return _nominal(count, period_s, "no timestamp file", is_refused=False)
    stamps = read_timestamps(path)
    first_line = _line_of_first_frame(len(stamps), first_frame, last_frame, recorded_frames(layout))
    if first_line is None:
        misfit = f"{len(stamps)} lines fit frames {first_frame}..{last_frame} neither by number nor by count"
        return _nominal(count, period_s, f"{path.name}: {misfit}", is_refused=True)
    lines = slice(first_line, first_line + count)
    section = stamps[lines]
    if np.isnat(section).any() or (np.diff(section) <= np.timedelta64(0, "ns")).any():
        misfit = f"{path.name} has gaps or steps back in this section"
        return _nominal(count, period_s, misfit, is_refused=True)
    time_s = (section - section[0]) / np.timedelta64(1, "s")
    times = spaced_times(time_s, period_s, str(path.relative_to(layout.root)))
    if times.is_assumed:
        return times
    sweep_s = given_period_s
    if sweep_s is None and path == layout.timestamps_path():
        sweep_s = _recorded_sweep_s(layout, len(stamps), lines)
    origin_s = seconds_since_1970(section[0])
    return replace(
        times, sweep_period_s=sweep_of(sweep_s, times.sweep_period_s),
        origin_s=origin_s if origin_s >= FIRST_DATE_S else None,
    )  # fmt: skip


def sweep_of(known_s: float | None, step_s: float) -> float:
    """Duration of a sweep: the known one where it can be a LiDAR's and is another than the frames' step."""
    if known_s is None or not SHORTEST_STEP_S <= known_s <= LONGEST_STEP_S:
        return step_s
    return known_s if abs(known_s - step_s) > UNLIKE * step_s else step_s


def _recorded_sweep_s(layout: DriveLayout, n_lines: int, section: slice) -> float | None:
    """Median time from a sweep's begin to its end; None unless there are files of both, line for line."""
    paths = [layout.timestamps_path(kind) for kind in ("start", "end")]
    if not all(lexists(path) for path in paths):
        return None
    try:
        begin, end = (read_timestamps(path) for path in paths)
    except DataError:  # the frames' own times are known: these files are not needed
        return None
    if not len(begin) == len(end) == n_lines:
        return None
    lasts_s = (end[section] - begin[section]) / np.timedelta64(1, "s")
    known_s = lasts_s[np.isfinite(lasts_s)]
    return float(np.median(known_s)) if len(known_s) else None


def spaced_times(time_s: np.ndarray, period_s: float, source: str) -> FrameTimes:
    """Times of frames if their steps can be a LiDAR's or a camera's, else nominal ones and why.

    Args:
        time_s: (n,) ascending, seconds since the first frame.
        period_s: Nominal time from frame to frame, and of a single one.
        source: Where the times stand, for messages.
    """
    count = len(time_s)
    steps_s = np.diff(time_s) if count > 1 else np.array([period_s])
    median_s, longest_s = float(np.median(steps_s)), float(steps_s.max())
    shortest_s = float(steps_s.min())
    is_even = SHORTEST_STEP_S <= median_s <= LONGEST_STEP_S and shortest_s >= LEAST_OF_MEDIAN * median_s
    if not is_even or longest_s > LONGEST_PAUSE_S:
        misfit = (
            f"{source}: frames {shortest_s:g} to {longest_s:g} s apart, {median_s:g} s in the median; "
            f"expected a median of {SHORTEST_STEP_S:g} to {LONGEST_STEP_S:g} s, at least "
            f"{LEAST_OF_MEDIAN:g} of it and at most {LONGEST_PAUSE_S:g} s: another unit?"
        )
        return _nominal(count, period_s, misfit, is_refused=True)
    return FrameTimes(time_s, median_s, False, source)


def read_timestamps(path: Path) -> np.ndarray:
    """Read `YYYY-MM-DD hh:mm:ss.nnnnnnnnn` lines as (n,) datetime64[ns]; an empty line is NaT.

    Raises:
        DataError: The file is too large or not text, or a line is not a time; file, line, remedy are named.
    """
    try:
        lines = read_text(path, MOST_TIMESTAMP_BYTES).rstrip().splitlines()
    except (OSError, ValueError) as error:
        raise DataError(
            f"cannot read times {path} ({error}); restore the file, or remove it: {_WITHOUT}"
        ) from error
    stamps = np.full(len(lines), np.datetime64("NaT", "ns"))
    for index, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            stamps[index] = _instant(line.strip())
        except ValueError as error:
            raise DataError(
                f"{path}, line {index + 1}: expected `YYYY-MM-DD hh:mm:ss.nnnnnnnnn`, found "
                f"{line[:_LONGEST_SHOWN]!r}; restore the file, or remove it: {_WITHOUT}"
            ) from error
    return stamps


def seconds_since_1970(stamp: np.datetime64) -> float:
    """A time of `read_timestamps` as seconds from 1970-01-01; files have no time zone."""
    return float((stamp - np.datetime64(0, "s")) / np.timedelta64(1, "s"))


def _instant(text: str) -> np.datetime64:
    """Date and time, to the nanosecond.

    Raises:
        ValueError: Date or time is incomplete: numpy would also read `2013`, `2013-05`, `NaT` and `now`.
    """
    if not _TIME.fullmatch(text):
        raise ValueError(text[:_LONGEST_SHOWN])
    return np.datetime64(text.replace(" ", "T", 1), "ns")


def _nominal(count: int, period_s: float, reason: str, *, is_refused: bool) -> FrameTimes:
    source = f"assumed {period_s:g} s a frame: {reason}"
    return FrameTimes(np.arange(count) * period_s, period_s, True, source, is_refused)


def _timestamp_file(layout: DriveLayout) -> Path | None:
    """The file of the scans' times; in a camera-only drive, of the first camera that has one."""
    candidates = [layout.timestamps_path()]
    candidates += [layout.camera_timestamps_path(name) for name in CAMERAS]
    # If it is not a regular file it is refused when it is read.
    return next((path for path in candidates if lexists(path)), None)


def recorded_frames(layout: DriveLayout) -> list[int]:
    """Frame numbers of the scans on disk, ascending; in a camera-only drive, of the first camera's images."""
    folders = [layout.scan_path(0).parent] + [layout.camera_dir(name) for name in CAMERAS]
    for folder in folders:
        if folder.is_dir():
            names = [path.stem for path in folder.iterdir()]
            return sorted(int(name) for name in names if name.isascii() and name.isdecimal())
    return []


def _line_of_first_frame(n_lines: int, first: int, last: int, recorded: list[int]) -> int | None:
    """Index of the line of frame `first`, or None if the number of lines does not fit."""
    is_cut_out = bool(recorded) and recorded[0] > 0 and recorded[-1] - recorded[0] + 1 == n_lines
    if is_cut_out and recorded[0] <= first and last <= recorded[-1]:
        return first - recorded[0]
    if n_lines > last:
        return first
    return 0 if n_lines == last - first + 1 else None


def read_poses(path: Path) -> dict[int, np.ndarray]:
    """Read `poses.txt`: for each frame number (4, 4) float64, pose frame to world.

    Frames without a line are not in the result (KITTI-360 has none where the car hardly moved).

    Raises:
        DataError: The file is absent, or a line cannot be read; file, line and remedy are named.
    """
    return _read_lines(path, 12)


def read_cam0_to_world(path: Path) -> dict[int, np.ndarray]:
    """Read `cam0_to_world.txt`: for each frame number (4, 4) float64, rectified camera 0 to world.

    Raises:
        DataError: The file is absent, or a line cannot be read; file, line and remedy are named.
    """
    return _read_lines(path, 16)


@dataclass(frozen=True, slots=True)
class PoseDisagreement:
    """Largest difference between two sources of the same poses."""

    frames: int
    """Number of frames with a pose in both."""
    translation_m: float
    rotation_deg: float


def compare_poses(left: dict[int, np.ndarray], right: dict[int, np.ndarray]) -> PoseDisagreement:
    """Largest distance and largest angle between two tables of poses (4, 4), over their common frames."""
    common = sorted(left.keys() & right.keys())
    if not common:
        return PoseDisagreement(0, float("nan"), float("nan"))
    a = np.stack([left[frame] for frame in common])
    b = np.stack([right[frame] for frame in common])
    shift_m = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    # |A - B| = 2 sqrt(2) sin(angle / 2): well conditioned near 0, where the trace formula is not.
    chord = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2)) / np.sqrt(8.0)
    angle_rad = 2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))
    return PoseDisagreement(len(common), float(shift_m.max()), float(np.degrees(angle_rad.max())))


def _read_lines(path: Path, count: int) -> dict[int, np.ndarray]:
    """Poses (4, 4) by frame number, from lines of a frame number and `count` matrix entries."""
    try:
        text = read_text(path, _MOST_POSE_BYTES)
    except (OSError, ValueError) as error:
        raise DataError(
            f"cannot read poses {path} ({error}); unpack the drive's `data_poses` folder there"
        ) from error
    if text.count("\n") > _MOST_LINES:
        raise DataError(
            f"{path}: expected at most {_MOST_LINES:,} lines, found more; cut the drive into parts"
        )
    poses: dict[int, np.ndarray] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            values = parse_numbers(line, count + 1)
            if not 0 <= values[0] <= LAST_FRAME or values[0] != int(values[0]):
                raise ValueError(f"expected a frame number, found {values[0]}")
            frame = int(values[0])
            if frame in poses:
                raise ValueError(f"frame {frame} has a pose already")
            if count == 16 and np.abs(values[13:] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
                raise ValueError(f"frame {frame}: expected the last row 0 0 0 1, found {values[13:]}")
            poses[frame] = _pose(frame, values[1:13])
        except ValueError as error:
            raise DataError(
                f"{path}, line {number}: {error} (a line is: frame number, {count} matrix entries); "
                "restore the file of the drive, or delete the line: its frame is then left out"
            ) from error
    return poses


def _pose(frame: int, values: np.ndarray) -> np.ndarray:
    try:
        return rigid(values, FARTHEST_M)
    except ValueError as error:
        raise ValueError(f"frame {frame}: {error}") from error
