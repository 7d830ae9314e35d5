"""The moments that a view asks for, and whether a drive can give them: found before anything is trained."""

import importlib.util
from collections.abc import Sequence

import numpy as np

from nvsf_core.drives.drive import AbstractDrive, drive_of, has_data
from nvsf_core.drives.entries import SceneEntry, ViewEntry
from nvsf_core.drives.kinds import MOST_FRAMES
from nvsf_core.drives.kitti360.frames import FrameTimes
from nvsf_core.drives.view_entry import NO_SENSOR
from nvsf_core.drives.view_parts import FARTHEST_SHIFT_M, tilted_words
from nvsf_core.errors import DataError, NvsfError
from nvsf_core.geometry.camera_fan import require_coverage
from nvsf_core.geometry.fisheye import shown_as
from nvsf_core.sensors.tables import SENSOR_TABLES

_SLACK_S = 1e-6
"""Times may lie outside the drive by this rounding error."""


_EXTRAS = {"laz": ("laspy", "lazrs"), "mcap": ("rosbags",), "rosbag2": ("rosbags",)}
"""Formats that packages write which may not be installed."""


def path_span_s(view: ViewEntry) -> tuple[float, float] | None:
    """First and last moment of a view's own path; None on the recorded one. One pose holds at any time."""
    times_s = [point.time_s for point in view.waypoints]
    if view.pose_file is not None:
        times_s = list(view.pose_file.time_s)
    if not times_s:
        return None
    return (times_s[0], times_s[-1]) if len(times_s) > 1 else (-np.inf, np.inf)


def moments_s(view: ViewEntry, frames: Sequence[int] | np.ndarray, frame_time_s: np.ndarray) -> np.ndarray:
    """Moments (n,) of a view's path at which its sensors are, seconds since the scene's first frame.

    Args:
        view: The view.
        frames: (m,) ascending numbers of the frames that there are.
        frame_time_s: (m,) their times.

    Raises:
        DataError: A frame that is asked for is not among them, or there is no moment at all, or too many; the
            message says what is allowed.
    """
    start_s, end_s = path_span_s(view) or (-np.inf, np.inf)
    first_s, last_s = float(frame_time_s[0]), float(frame_time_s[-1])
    if view.frozen_at_s is None or not np.isfinite([start_s, end_s]).all():
        span_s = max(start_s, first_s), min(end_s, last_s)
    else:
        span_s = (
            start_s,
            end_s,
        )  # while the scene is frozen, a path of one's own may last longer than the drive
    if span_s[1] < span_s[0] - _SLACK_S:
        raise DataError(
            f"expected a path between {first_s:.10g} and {last_s:.10g} seconds after the scene's first "
            f"frame, found one from {start_s:.10g} to {end_s:.10g}; correct its times"
        )
    if view.times_s is not None:
        found: np.ndarray = np.asarray(view.times_s, np.float64)
    elif view.rate_hz is not None:
        step_s = view.speed / view.rate_hz
        count = int(np.floor(max(0.0, span_s[1] - span_s[0]) / step_s + _SLACK_S)) + 1
        if count > MOST_FRAMES:
            raise DataError(f"rate_hz: expected at most {MOST_FRAMES:,} instants, found {count:,}; lower it")
        found = span_s[0] + step_s * np.arange(count)
    elif view.frames == "all":
        found = frame_time_s[(frame_time_s >= span_s[0] - _SLACK_S) & (frame_time_s <= span_s[1] + _SLACK_S)]
    else:
        # Ascending whatever order they are asked for in: a data set's clock never runs backwards.
        wanted = np.unique(np.asarray(view.frames, np.int64))
        missing = sorted(set(wanted.tolist()) - set(np.asarray(frames).tolist()))
        if missing:
            raise DataError(
                f"frames: expected frames with a pose, found none for {missing!s:.200}; ask for others of "
                f"{min(frames)}..{max(frames)}"
            )
        found = frame_time_s[np.searchsorted(frames, wanted)]
    outside = [float(one) for one in found if not span_s[0] - _SLACK_S <= one <= span_s[1] + _SLACK_S]
    if outside or len(found) == 0:
        where = "of the path that is given" if np.isfinite(start_s) else "of the drive"
        raise DataError(
            f"expected times from {span_s[0]:g} to {span_s[1]:g} seconds {where}, found {outside!s:.200}; "
            "frame numbers are asked for by `frames`"
        )
    return np.asarray(found, np.float64)


def asked_frames(view: ViewEntry, drive: AbstractDrive) -> np.ndarray:
    """Numbers (n,) of the frames at whose times a view of `frames` has its sensors, ascending.

    Raises:
        DataError: See `moments_s`; or the drive's times cannot be read.
        OSError: The same.
    """
    frames, time_s = np.asarray(drive.frames, np.int64), drive.times().time_s
    posed = _posed(drive, frames)
    moments = moments_s(view, frames[posed], time_s[posed])
    return np.asarray(frames[posed][np.isin(time_s[posed], moments)])


def _posed(drive: AbstractDrive, frames: np.ndarray) -> np.ndarray:
    """(m,) bool: which frames (m,) have a pose; all, where the stage `frames` will say what is wrong."""
    try:
        poses = drive.facts().poses
    except (NvsfError, OSError):
        return np.ones(len(frames), np.bool_)
    found = np.isin(frames, list(poses))
    return found if found.any() else np.ones(len(frames), np.bool_)


def require_views(scene: SceneEntry) -> None:
    """Refuse views that ask for times, frames or cameras that the scene's drive does not have.

    Raises:
        DataError: There is such a view; the message names it, what it asks for, and what is allowed.
    """
    for view in scene.views:
        for name in view.exports:
            absent = [
                package for package in _EXTRAS.get(name, ()) if importlib.util.find_spec(package) is None
            ]
            if absent:
                raise DataError(
                    f"view {view.name}: exports: {name} is written by {' and '.join(absent)}, not "
                    "installed here: pip install 'nvsf[exports]', or leave it out"
                )
    if not scene.views:
        return
    drive = drive_of(scene)
    try:
        times = drive.times()
    except (DataError, OSError):
        return  # the stage `frames` reports what is wrong with the drive
    frames, end_s = np.arange(scene.first_frame, scene.last_frame + 1), float(times.time_s[-1])
    posed = _posed(drive, frames)
    for view in scene.views:
        where = f"scene {scene.name}, view {view.name}"
        try:
            moments = moments_s(view, frames[posed], times.time_s[posed])
            if scene.is_to_compensate:
                _require_sweeps_within(view, moments, drive, times)
        except DataError as error:
            raise DataError(f"{where}: {error} ({len(frames)} frames, {times.source})") from error
        if view.frozen_at_s is not None and not -_SLACK_S <= view.frozen_at_s <= end_s + _SLACK_S:
            raise DataError(
                f"{where}: frozen_at_s: expected 0 to {end_s:g} seconds, found {view.frozen_at_s:g}"
            )
        if not has_data(scene):
            continue  # the embedded street is not written yet, or the drive is elsewhere
        _require_near(view, drive, where)
        _require_beam_width(view, drive, where)
        needed = [*(view.cameras or ()), *(camera.like for camera in view.camera)]
        absent = [name for name in needed if drive.camera_place(name) is None]
        if absent:
            raise DataError(
                f"{where}: expected cameras that the drive has, found {absent[0]}: there are no "
                f"images of it below {scene.root}"
            )
        _require_covered(view, drive, where)


def _require_sweeps_within(
    view: ViewEntry, moments: np.ndarray, drive: AbstractDrive, times: FrameTimes
) -> None:
    """Refuse moments of the recorded path about which a sweep of the view reaches beyond its ends.

    A fast or slowly turning sensor goes a longer way in a sweep. The path is prolonged by one frame. A drive
    without scans has no sweeps to ask about.
    """
    if not view.is_on_recorded_path or view.sensor == NO_SENSOR or len(times.time_s) < 2:
        return
    half_s = 0.5 * view.speed * (times.sweep_period_s if view.own_rate_hz is None else 1.0 / view.own_rate_hz)
    spare_s = float(np.median(np.diff(times.time_s))) - half_s
    first_s, last_s = float(times.time_s[0]) - spare_s, float(times.time_s[-1]) + spare_s
    outside = moments[(moments < first_s - _SLACK_S) | (moments > last_s + _SLACK_S)]
    if len(outside) and any(drive.find_scan(frame) is not None for frame in drive.frames):
        what = (
            f"times from {first_s:g} to {last_s:g} seconds, found {outside.tolist()!s:.200}"
            if first_s <= last_s
            else f"a path at least as long, found one of {np.ptp(times.time_s):g} s; lower `speed`"
        )
        raise DataError(
            f"speed and sensor: a sweep goes on for {2 * half_s:g} s of the recorded path: expected {what}"
        )


def _require_beam_width(view: ViewEntry, drive: AbstractDrive, where: str) -> None:
    """Refuse beams with a width by the recording sensor where that width is not known."""
    if not view.footprint or view.sensor is not None:
        return
    try:
        sensor = drive.facts().sensor
    except (NvsfError, OSError):
        return  # the stage `frames` says what is wrong with the drive
    if sensor not in SENSOR_TABLES or SENSOR_TABLES[sensor].divergence_mrad == 0.0:
        name = sensor if sensor in SENSOR_TABLES else "a sensor that is found"
        raise DataError(
            f"{where}: footprint: the beam width of {name} is not known; give it as "
            "`divergence_mrad` of a [[sensor]] of your own, or leave `footprint` out"
        )


def _require_covered(view: ViewEntry, drive: AbstractDrive, where: str) -> None:
    """Refuse cameras of other intrinsics that see more than images of the recorded camera `like` cover."""
    if not view.camera:
        return
    try:
        recorded = drive.facts().calibration.cameras
    except (NvsfError, OSError):
        return  # the stage `frames` says what is wrong with the drive
    for camera in view.camera:
        if camera.like not in recorded:
            continue  # it has images, but no calibration: the stage `frames` says so
        lens = recorded[camera.like].intrinsics
        try:
            require_coverage(camera.model(), shown_as(lens))
        except DataError as error:
            raise DataError(f"{where}, camera {camera.name}, like {camera.like}: {error}") from error


def _require_near(view: ViewEntry, drive: AbstractDrive, where: str) -> None:
    """Refuse a path in the world that is nowhere near the drive's own."""
    if view.is_on_recorded_path or view.path_in != "world":
        return
    known_m = drive.places_m()
    if len(known_m) == 0:
        return
    asked_m = np.array([point.position_m for point in view.waypoints], np.float64).reshape(-1, 3)
    if view.pose_file is not None:
        asked_m = np.array(view.pose_file.poses).reshape(-1, 3, 4)[:, :, 3]
    for place_m in asked_m:
        apart_m = float(np.linalg.norm(known_m - place_m, axis=1).min())
        if not apart_m <= FARTHEST_SHIFT_M:
            raise DataError(
                f"{where}: expected a path within {FARTHEST_SHIFT_M:g} m of the drive, found a pose "
                f"{apart_m:,.0f} m away; is it given in another frame than the drive's world (`path_in`)?"
            )


def described(scene: SceneEntry) -> list[str]:
    """What each view of a scene asks for, in a line, after `require_views` has found nothing wrong.

    Raises:
        DataError: See `require_views`.
    """
    require_views(scene)
    drive = drive_of(scene)
    try:
        times = drive.times()
    except (DataError, OSError) as error:
        return [
            f"{view.name}: keys are fine; its times cannot be compared with the drive: {error}"
            for view in scene.views
        ]
    frames, lines = np.arange(scene.first_frame, scene.last_frame + 1), []
    for view in scene.views:
        moments = moments_s(view, frames, times.time_s)
        still = "" if view.frozen_at_s is None else f", all at {view.frozen_at_s:g} s"
        path = "the recorded path" if view.is_on_recorded_path else "a path of its own"
        words = "" if view.pose_file is None else tilted_words(view.pose_file.poses)
        tilted = f", where {words}" if words else ""
        lines.append(
            f"{view.name}: {len(moments)} instants, {moments[0]:g} to {moments[-1]:g} s on {path}{still}"
            f"{tilted}; LiDAR {view.sensor_name or 'as recorded'}; exports {', '.join(view.exports)}"
        )
    return lines
