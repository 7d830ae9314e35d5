"""The page docs/catalogue.md: every key of a catalogue, from the entries' own fields.

`python -m nvsf_core.drives.catalogue_page > docs/catalogue.md` writes it; a test compares the two.
"""

import ast
import inspect
import sys
from collections.abc import Sequence
from dataclasses import MISSING, fields

import numpy as np

from nvsf_core.drives.entries import SceneEntry
from nvsf_core.drives.view_entry import EXPORTS, ViewEntry
from nvsf_core.drives.view_parts import CameraEntry, SensorEntry, Waypoint
from nvsf_core.sensors.tables import SENSOR_TABLES

_HEAD = """# The catalogue

Made by `python -m nvsf_core.drives.catalogue_page`; a test compares the two. `NVSF_SCENES` names catalogues,
apart by colons; without it the project's `scenes.toml` is used. A mistake is refused before anything is
trained; `nvsf view --check` says it at once. The same keys make a view in Python, `render_view("demo",
{"shift_m": [0, 1, 0]})`, and on the command line, `nvsf view demo 'shift_m = [0, 1, 0]' 'sensor = "VLP-16"'`.

Times are seconds since the scene's first frame. A view has two clocks: where the sensors are (`frames`,
`times_s` or `rate_hz`, on the recorded path or a given one), and the scene's, which `frozen_at_s` stops:
then all that moves is where it was at that instant, while the LiDAR still rotates and its car still drives,
so scans have the distortion of a moving car as recorded ones do. Files are stamped by the sensors' clock.
"""
_FORMATS = {
    "bin": "KITTI's `velodyne_points/data/*.bin`: float32 x, y, z, intensity",
    "ply": "binary PLY with x, y, z, intensity",
    "pcd": "PCD with x, y, z, intensity",
    "laz": "LAZ 1.4 with `ring`, `time`, `support` as further dimensions (extra `exports`)",
    "kitti": "a sequence of KITTI's odometry benchmark: `poses`, `calib.txt`, `times.txt`; `image_2` is the"
    " pinhole camera that looks ahead, `image_3` another one of the same axes. Scans are as measured from the"
    " moving car, while the benchmark's are compensated: `velodyne_time` has each point's time (of a scene"
    " with `compensate = false` they are of one instant, all times 0)",
    "kitti360": "a KITTI-360 root: calibration, poses, timestamps, boxes, and `ring` and `time` of each point"
    " beside the scans; this project ingests it again. Fisheyes of `[[view.camera]]` have the places of such,"
    " `image_02` and `image_03`, where these are free",
    "mcap": "a ROS 2 bag (Humble and newer) in an MCAP file: points, images, depth, instance images,"
    " camera info, transforms, and no boxes, which the manifest has (extra `exports`)",
    "rosbag2": "the same bag in an SQLite file, `.db3` (extra `exports`)",
    "nuscenes": "nuScenes' tables and files, version `v1.0-nvsf`: LIDAR_TOP, pinhole cameras (the one that"
    " looks ahead is CAM_FRONT), annotations",
}


def as_markdown() -> str:
    """The page."""
    parts = [_HEAD]
    for title, kind, left_out in (
        ("`[[scene]]`: a section of a drive", SceneEntry, {"views"}),
        ("`[[view]]`: a synthetic data set", ViewEntry, set[str]()),
        ("`waypoints` of a view", Waypoint, set[str]()),
        ("`[[view.camera]]`: a camera of other intrinsics", CameraEntry, set[str]()),
        ("`[[sensor]]`: a LiDAR of your own", SensorEntry, set[str]()),
    ):
        rows = [row for row in _rows(kind) if row[0].strip("`") not in left_out]
        parts.append(f"## {title}\n\n" + _table(("key", "default", "meaning"), rows))
    lasers = [
        (
            f"`{one.name}`", str(one.laser_count),
            f"{np.degrees(one.elevation_rad[0]):.1f} to {np.degrees(one.elevation_rad[-1]):.1f}",
            f"{360.0 / one.firings_per_turn:.3f}", f"{one.max_range_m:g}",
            f"{one.divergence_mrad:g}" if one.divergence_mrad else "not known",
        )
        for one in SENSOR_TABLES.values()
    ]  # fmt: skip
    head = ("sensor", "lasers", "elevation, degrees", "azimuth step, degrees", "range, m", "beam, mrad")
    parts.append(
        "## Known LiDARs\n\nThey rotate as fast as the drive's own, and see at most as far. Where each "
        "figure comes from stands in `nvsf_core/sensors/tables.py`.\n\n" + _table(head, lasers)
    )
    formats = [(f"`{name}`", _FORMATS[name]) for name in EXPORTS]
    parts.append(
        "## Formats of `exports`\n\nImages always come as PNG, beside them depth (uint16, 1/256 m along the "
        "optical axis, of a fisheye along the ray, 0 = not known: of the sky, and of bright blank walls "
        "above all returns, which images do not tell from it) and, where objects are labelled or found "
        "to move, instances (uint16; the manifest's `instances` says which object each value is). Where a "
        "format's points have no ring, time and support of their own, these lie beside them: "
        "`velodyne_points/ring` (uint16, 0 = top laser in every format; Velodyne's driver counts from the "
        "lowest), `time` (float32 seconds after the stamp), `support` (uint8: 0 "
        "guessed, 1 extrapolated, 2 seen). What a format of a whole data set calls each camera, and which it "
        "leaves out, stands in the manifest (`camera_names`) and on the card.\n\n"
        + _table(("format", "what"), formats)
    )
    return "\n".join(parts)


def _rows(kind: type) -> list[tuple[str, str, str]]:
    meaning = _meanings(kind)
    return [(f"`{one.name}`", _default(one.default), meaning[one.name]) for one in fields(kind)]


def _default(value: object) -> str:
    if value is MISSING:
        return "needed"
    if value in (None, ()):
        return "none"
    if isinstance(value, tuple):
        return f"`[{', '.join(str(one) if not isinstance(one, str) else repr(one) for one in value)}]`"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _meanings(kind: type) -> dict[str, str]:
    """Field to the text that stands under it in the source."""
    (body,) = (node for node in ast.parse(inspect.getsource(kind)).body if isinstance(node, ast.ClassDef))
    found: dict[str, str] = {}
    for node, after in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
            and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        ):  # fmt: skip
            found[node.target.id] = " ".join(str(after.value.value).split())
    return found


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    cells = [head, *rows]
    lines = ["| " + " | ".join(one.replace("|", "\\|") for one in row) + " |" for row in cells]
    lines.insert(1, "|" + " --- |" * len(head))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(as_markdown())
