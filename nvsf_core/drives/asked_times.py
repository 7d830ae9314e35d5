"""Whether the times that views ask for lie within the drive, as far as can be told before it is read."""

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.kitti360.layout import DriveLayout
from nvsf_core.drives.kitti360.timestamps import frame_times
from nvsf_core.errors import DataError

_SLACK_S = 1e-6


def require_times_in_drive(scene: SceneEntry) -> None:
    """Refuse a view of a time before the drive's first frame or after its last: nothing is known of then.

    Raises:
        DataError: Names the view, the times and what the drive has.
    """
    asked = [view for view in scene.views if view.times_s is not None]
    if not asked:
        return
    try:
        layout = DriveLayout(scene.root, scene.sequence)
        times = frame_times(layout, scene.first_frame, scene.last_frame, scene.sweep_period_s)
    except (DataError, OSError):
        return  # the stage `frames` says what is wrong with the drive
    end_s = float(times.time_s[-1])
    for view in asked:
        outside = [time_s for time_s in view.times_s or () if not -_SLACK_S <= time_s <= end_s + _SLACK_S]
        if outside:
            raise DataError(
                f"scene {scene.name}, view {view.name}: expected times from 0 to {end_s:g} seconds "
                f"({len(times.time_s)} frames, {times.source}), found {outside!s:.200}; frame numbers are "
                "written without a point"
            )
